"""Exports of a part of a version to formats of other libraries.

Samples are in the order of their slots, and are written one at a time.

Rejected samples are left out in every format, so no fill value is ever taken for a sample. The
array `slot` says which slot of the version each sample has. An export is there whole or not at all,
and overwrites nothing.
"""

import io
import os
import shutil
import tarfile
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base import sha256
from stickslip_schemas.format.selection import Selection
from stickslip_schemas.kinds.cloth.arrays import PICTURE_SIZE
from stickslip_schemas.spec.arrays import SPLITS, ArrayLayout, describe
from stickslip_schemas.store import sync

from stickslip_training.arrays import Array
from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.sources import CorruptDataError
from stickslip_training.export.masks import SEGMENTATION, document
from stickslip_training.export.strict_json import strict_json

OnBytes = Callable[[int], None]
"""Hears how many decoded bytes have been written."""

SLOT = ArrayLayout("slot", "int64", (), (), "slot of the sample in the version")
MANIFEST_COPY = "source-manifest.json"
DESCRIPTION = "dataset.json"
FILE_BYTES = 256 * 2**20
"""Decoded samples that go into one file, if a format has many files [bytes]."""

CHUNK_BYTES = 2**20
"""Decoded samples of a chunk of HDF5 [bytes]."""

MESH_PARTS = ("positions", "rest", "triangles")
"""Arrays of a sheet that make a mesh."""

GROUP_BYTES = 32 * 2**20
"""Decoded samples that are written to Parquet and read from it together [bytes]."""


class Content:
    """The part of a version that is exported."""

    def __init__(self, reader: DatasetReader, selection: Selection) -> None:
        """Choose; raise ValueError if the selection makes no sense or leaves no sample."""
        self.reader = reader
        self.selection = selection
        everything = reader.arrays.values()
        chosen = reader.chosen & selection.choose_samples(everything, reader.label)
        self.slots = np.flatnonzero(chosen).astype(np.int64)
        if not len(self.slots):
            raise ValueError(
                f"no valid sample is in this part of the dataset: {selection.model_dump_json()}"
            )
        # All samples of an export are valid.
        self.arrays = (
            SLOT,
            *(array for array in selection.choose_arrays(everything) if array.name != "valid"),
        )

    @property
    def name(self) -> str:
        """The version, as `ds-...:v1`."""
        return f"{self.reader.manifest.dataset}:v{self.reader.manifest.version}"

    @property
    def title(self) -> str:
        """A name for people."""
        return self.reader.spec.name or self.reader.manifest.dataset

    @property
    def sample_bytes(self) -> int:
        """Decoded size of one sample [bytes]."""
        return sum(array.sample_bytes for array in self.arrays)

    @property
    def labels(self) -> tuple[ArrayLayout, ...]:
        return tuple(array for array in self.arrays if array.is_label)

    def read(self, name: str, slots: npt.NDArray[np.int64]) -> Array:
        """Return an array of samples, (len(slots), *sample shape)."""
        if name == SLOT.name:
            return slots
        if self.reader.arrays[name].is_label:
            return self.reader.label(name)[slots]
        return self.reader.read(name, slots)

    def picture(self, name: str, slot: int) -> Array:
        """Return the frames (n, y, x, ...) of a sample, as large as its picture is.

        If viewpoints differ in size, arrays have the largest one.
        """
        frames: Array = self.read(name, np.array([slot]))[0]
        if PICTURE_SIZE.name not in self.reader.arrays:
            return frames
        width, height = self.reader.label(PICTURE_SIZE.name)[slot].tolist()
        return frames[:, :height, :width]

    def parts(self) -> Iterator[tuple[str, int, int, npt.NDArray[np.int64]]]:
        """Yield split, number, count of the files of that split, and slots of each file.

        Files are in the order of the splits.
        """
        size = max(1, FILE_BYTES // self.sample_bytes)
        splits = self.reader.label("split")[self.slots]
        for code, split in enumerate(SPLITS):
            slots = self.slots[splits == code]
            count = -(-len(slots) // size)
            for number in range(count):
                yield split, number, count, slots[number * size : (number + 1) * size]

    def manifest(self) -> bytes:
        """Return the bytes of the version's manifest."""
        data = self.reader.source.read_manifest()
        if sha256(data) != self.reader.manifest_digest:
            raise CorruptDataError(
                f"the manifest of {self.reader.source} has changed since it was opened"
            )
        return data

    def identity(self) -> dict[str, Any]:
        """Return which version, and which part of it, the export is of."""
        manifest = self.reader.manifest
        return {
            "dataset": manifest.dataset,
            "version": manifest.version,
            "kind": self.reader.kind,
            "manifest_sha256": self.reader.manifest_digest,
            "certificate": manifest.certificate,
            "selection": self.selection.model_dump(mode="json"),
            "sample_count": len(self.slots),
        }

    def description(self) -> bytes:
        """Return a JSON document that describes the export and each of its arrays."""
        arrays = {
            array.name: {
                "dtype": array.dtype,
                "shape": list(array.shape),
                "dimensions": list(array.dimensions),
                **describe(array),
            }
            for array in self.arrays
        }
        return (strict_json(self.identity() | {"arrays": arrays}, indent=2) + "\n").encode()


def to_directory(
    content: Content,
    target: Path,
    on_bytes: OnBytes,
    write: Callable[[Content, Path, OnBytes], None],
) -> None:
    """Let `write` fill a directory, and add the manifest and a description."""
    with made_whole(target) as scratch:
        scratch.mkdir()
        (scratch / MANIFEST_COPY).write_bytes(content.manifest())
        (scratch / DESCRIPTION).write_bytes(content.description())
        write(content, scratch, on_bytes)


@contextmanager
def made_whole(target: Path) -> Iterator[Path]:
    """Yield a path beside `target` to write to, which becomes `target` at the end.

    After an error nothing is left.

    Raises FileExistsError, and overwrites nothing, if `target` exists.
    """
    _refuse_existing(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    scratch = target.with_name(f".{target.name}.{uuid.uuid4().hex}.tmp")
    try:
        yield scratch
        for path in [scratch, *scratch.rglob("*")]:
            sync(path)
        _refuse_existing(target)
        scratch.rename(target)
        sync(target.parent)
    finally:
        if scratch.is_dir():
            shutil.rmtree(scratch)
        else:
            scratch.unlink(missing_ok=True)


def _refuse_existing(target: Path) -> None:
    if os.path.lexists(target):
        raise FileExistsError(
            f"{target} exists, and an export overwrites nothing: name another place"
        )


# --- formats: functions write into a new file or an empty directory
# ------------------------------------------


def write_hdf5(content: Content, path: Path, on_bytes: OnBytes) -> None:
    """Write one file: a dataset for each array, with the names, types and values of the version.

    The first dimension is the sample, and `slot` says which one. Every chunk has a checksum
    (fletcher32), which the HDF5 library checks.
    """
    import h5py

    count = len(content.slots)
    with h5py.File(path, "x") as file:
        for name, value in content.identity().items():
            file.attrs[name] = strict_json(value) if isinstance(value, dict) else value or ""
        manifest = np.frombuffer(content.manifest(), dtype=np.uint8)
        file.create_dataset(
            "manifest.json",
            data=manifest,
            chunks=manifest.shape,
            compression="gzip",
            fletcher32=True,
        )
        for array in content.arrays:
            rows = max(1, min(count, CHUNK_BYTES // array.sample_bytes))
            shape = (count, *array.shape)
            chunks = (rows, *array.shape)
            out = file.create_dataset(
                array.name, shape=shape, dtype=array.dtype, chunks=chunks, fletcher32=True
            )
            for dimension, name in zip(out.dims, ("sample", *array.dimensions), strict=True):
                dimension.label = name
            for key, value in describe(array).items():
                out.attrs[key] = strict_json(value) if isinstance(value, dict) else value
            for first in range(0, count, rows):
                slots = content.slots[first : first + rows]
                out[first : first + len(slots)] = content.read(array.name, slots)
                on_bytes(len(slots) * array.sample_bytes)


def write_webdataset(content: Content, directory: Path, on_bytes: OnBytes) -> None:
    """Write `train-000000.tar` and so on.

    A sample is `SLOT.json` with its labels, `SLOT.ARRAY.npy` for each other array, and, if the
    dataset has segmentation, `SLOT.coco.json` with masks and boxes of all things in all frames.

    Categories are codes, as in the version, and `dataset.json` names them. A label that is infinite
    or NaN is null.
    """
    big = [array.name for array in content.arrays if not array.is_label]
    for split, number, _, slots in content.parts():
        path = directory / f"{split}-{number:06d}.tar"
        with tarfile.open(path, "x", format=tarfile.USTAR_FORMAT) as tar:
            for slot in slots.tolist():
                _add(tar, f"{slot:08d}.json", strict_json(sample_labels(content, slot)).encode())
                # WebDataset groups the files of a sample by the name before the first dot.
                for name in big:
                    buffer = io.BytesIO()
                    values = content.read(name, np.array([slot]))[0]
                    np.save(buffer, values, allow_pickle=False)
                    _add(tar, f"{slot:08d}.{name}.npy", buffer.getvalue())
                if SEGMENTATION in big:
                    _add(tar, f"{slot:08d}.coco.json", _coco_document(content, slot))
                on_bytes(content.sample_bytes)


def _coco_document(content: Content, slot: int) -> bytes:
    """Return masks and boxes of the frames of a sample as a COCO document."""
    arrays = {array.name: array for array in content.arrays}
    names = arrays[SEGMENTATION].attributes["categories"]
    codes = content.picture(SEGMENTATION, slot)
    return strict_json(document(codes, names, f"{slot:08d}.video.npy[{{frame}}]")).encode()


def sample_labels(content: Content, slot: int) -> dict[str, Any]:
    """Return the labels of a sample as plain values."""
    alone = np.array([slot])
    return {array.name: content.read(array.name, alone)[0].tolist() for array in content.labels}


def _add(tar: tarfile.TarFile, name: str, data: bytes) -> None:
    """Add a file without a time or an owner: the same export has the same bytes."""
    member = tarfile.TarInfo(name)
    member.size = len(data)
    member.mode = 0o644
    tar.addfile(member, io.BytesIO(data))


def write_obj(content: Content, directory: Path, on_bytes: OnBytes) -> None:
    """Write `SLOT/0000.obj` and so on, and `SLOT/labels.json`.

    A file has all sheets at an instant.

    Meshes are in metres, z up, with the flat cloth as texture coordinates from 0 to 1 along its
    longer side. OBJ is text, and its numbers, read as 32-bit floats, are those of the dataset, bit
    by bit.
    """
    sheets = _sheets(content)
    for slot in content.slots.tolist():
        folder = directory / f"{slot:08d}"
        folder.mkdir()
        labels = strict_json(sample_labels(content, slot), indent=2)
        (folder / "labels.json").write_text(labels + "\n")
        for instant, text in enumerate(_obj_files(content, sheets, slot)):
            (folder / f"{instant:04d}.obj").write_text(text)
        on_bytes(content.sample_bytes)


def _sheets(content: Content) -> list[str]:
    """Return the prefixes of the arrays of all sheets: "" for the one sheet of a drag.

    Raises ValueError if an array of a sheet is missing.
    """
    names = {array.name for array in content.arrays}
    positions = [name for name in sorted(names) if name.split(".")[-1] == "positions"]
    sheets = [name.removesuffix("positions") for name in positions]
    needed = [f"{sheet}{part}" for sheet in sheets or [""] for part in MESH_PARTS]
    missing = [name for name in needed if name not in names]
    if missing:
        raise ValueError(
            f"a mesh needs {', '.join(missing)}, which this part of {content.name} does not have"
        )
    return sheets


def _obj_files(content: Content, sheets: list[str], slot: int) -> list[str]:
    """Return the text of the OBJ file of each instant of a sample, with all sheets."""
    alone = np.array([slot])
    files: list[str] = []
    first_vertex = 1  # indices of OBJ begin at 1, and count over all sheets
    for sheet in sheets:
        positions, rest, triangles = (
            content.read(f"{sheet}{part}", alone)[0] for part in MESH_PARTS
        )
        # Texture coordinates and faces are the same at all instants.
        low = rest.min(axis=0)
        uv = ((rest - low) / (rest.max(axis=0) - low).max()).astype(np.float32)
        lines = [f"vt {u:.9g} {v:.9g}\n" for u, v in uv.tolist()]
        for a, b, c in (triangles + first_vertex).tolist():
            lines.append(f"f {a}/{a} {b}/{b} {c}/{c}\n")
        fixed = "".join(lines)
        first_vertex += len(rest)

        name = sheet.removesuffix(".") or "cloth"
        files = files or [""] * len(positions)
        for instant, vertices in enumerate(positions.tolist()):
            # Nine digits give each 32-bit float back, bit by bit.
            moved = "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices)
            files[instant] += f"o {name}\n{moved}{fixed}"
    return files


def write_huggingface(content: Content, directory: Path, on_bytes: OnBytes) -> None:
    """Write `data/train-00000-of-00002.parquet` and so on, and a card.

    Each file carries the features, so `datasets.load_dataset(DIR)` gives every array with its shape
    and type, and every categorical label with its names.
    """
    import datasets
    import pyarrow
    from pyarrow import parquet

    (directory / "data").mkdir()
    schema = datasets.Features(
        {array.name: _feature(array) for array in content.arrays}
    ).arrow_schema
    rows = max(1, GROUP_BYTES // content.sample_bytes)
    splits = []
    for split, number, count, slots in content.parts():
        splits += [split] if number == 0 else []
        path = directory / "data" / f"{split}-{number:05d}-of-{count:05d}.parquet"
        with parquet.ParquetWriter(
            path, schema, compression="zstd", write_page_checksum=True
        ) as writer:
            for first in range(0, len(slots), rows):
                batch = slots[first : first + rows]
                columns = [
                    _column(content.read(array.name, batch), schema.field(array.name).type)
                    for array in content.arrays
                ]
                writer.write_table(pyarrow.Table.from_arrays(columns, schema=schema))
                on_bytes(len(batch) * content.sample_bytes)
    (directory / "README.md").write_text(_card(content, splits), encoding="utf-8")


def _feature(array: ArrayLayout) -> Any:
    import datasets

    if array.categories:
        return datasets.ClassLabel(names=list(map(str, array.categories)))
    if not array.shape:
        return datasets.Value(array.dtype)
    if len(array.shape) == 1:
        return datasets.Sequence(datasets.Value(array.dtype), length=array.shape[0])
    return getattr(datasets, f"Array{len(array.shape)}D")(array.shape, array.dtype)


def _column(values: Array, kind: Any) -> Any:
    """Return values as an Arrow array of the type `kind`.

    The array has plain numbers, or lists in lists for the further axes.
    """
    import pyarrow

    column = pyarrow.array(values.reshape(-1))
    for size in values.shape[:0:-1]:
        column = pyarrow.FixedSizeListArray.from_arrays(column, size)
    if not isinstance(kind, pyarrow.ExtensionType):
        return column.cast(kind)
    return pyarrow.ExtensionArray.from_storage(kind, column.cast(kind.storage_type))


def _card(content: Content, splits: list[str]) -> str:
    files = "".join(f"  - split: {split}\n    path: data/{split}-*.parquet\n" for split in splits)
    arrays = "\n".join(
        f"| `{array.name}` | {' x '.join(map(str, array.shape)) or 'one value'} | "
        f"{array.dtype} | {array.description} |"
        for array in content.arrays
    )
    return f"""---
configs:
- config_name: default
  data_files:
{files}---

# {content.title}

This is an export of the dataset `{content.name}`, made by stickslip: {len(content.slots)} samples.
The manifest of that version is `{MANIFEST_COPY}` here. Its SHA-256 is
`{content.reader.manifest_digest}`.
`{DESCRIPTION}` describes the arrays for programs.

```python
from datasets import load_dataset

dataset = load_dataset("PATH OF THIS DIRECTORY").with_format("numpy")
```

The format "numpy" of `datasets` rounds float64 to float32, unless you give it a `dtype`.

| column | shape | type | meaning |
|---|---|---|---|
{arrays}
"""
