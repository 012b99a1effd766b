"""Read samples of a dataset version, from a directory, a bucket or over HTTP, into NumPy arrays.

Opening checks the seal, manifest, metadata and labels against one another. There are no threads and
nothing asynchronous, so a reader may be used before and after a fork, and it can be pickled.
Missing data raises; it is never replaced by zeros.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError
from stickslip_schemas.format.codecs import axes_order, in_order_of_chunks, packing
from stickslip_schemas.format.manifest import (
    GROUP_NAME,
    SEAL_NAME,
    BrokenSealError,
    FileEntry,
    Manifest,
    Rejection,
    check_seal,
    layout,
)
from stickslip_schemas.format.selection import SELECTION_NAME, PartDocument, Selection, part_files
from stickslip_schemas.spec.arrays import SPLITS, ArrayLayout
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_training.arrays import Array
from stickslip_training.data.index import Index
from stickslip_training.data.sources import (
    CorruptDataError,
    DirectorySource,
    InvalidDatasetError,
    MissingFileError,
    RejectedSampleError,
    Source,
    open_source,
)

Split = Literal["train", "validation", "test"]
Slots = Sequence[int] | npt.NDArray[np.integer[Any]]


class DatasetReader:
    """One version of a dataset, open for reading.

    Samples are named by their slot, 0 to `len(reader)` - 1.
    """

    manifest_digest: str
    """SHA-256 of the manifest."""
    selection: Selection
    """The part of the version that the source holds."""
    arrays: dict[str, ArrayLayout]

    def __init__(
        self,
        source: str | os.PathLike[str],
        *,
        api_key: str | None = None,
        verify: bool = False,
        check_shards: bool = True,
        cache_bytes: int = 256 * 2**20,
    ) -> None:
        """Open a version.

        Args:
            source: Directory of the version, or its URL (see `sources`).
            api_key: Key for the server of the URL. By default, the key of the environment variable
                `STICKSLIP_API_KEY` is sent to the coordinator of `STICKSLIP_URL`, and to no other.
            verify: Read every file first, and check it against the manifest.
            check_shards: Check a shard in a directory before its first sample is read. Over HTTP
                only `verify` checks shards, because samples are parts of them.
            cache_bytes: Memory for decoded chunks of curves, which hold many samples.

        Raises:
            DatasetError: The version is damaged, or contradicts the contract.
        """
        self.source = open_source(source, api_key=api_key)
        try:
            self.manifest_digest, group, manifest = _read_sealed(self.source)
            parsed = _parse_manifest(manifest)
            self.selection = _read_selection(self.source, self.manifest_digest)
            self.arrays = {
                array.name: array for array in self.selection.choose_arrays(layout(parsed.spec))
            }
            self.index = Index(
                self.source, parsed, self.arrays, check_shards=check_shards, cache_bytes=cache_bytes
            )
            if verify:
                self.verify()
            self._check_metadata(group)
            self._check_labels()
        except BaseException:
            self.close()
            raise

    @property
    def manifest(self) -> Manifest:
        return self.index.manifest

    @property
    def spec(self) -> JobSpec:
        """The spec of the job that made the version."""
        return self.manifest.spec

    @property
    def kind(self) -> str:
        """The kind of the dataset, `rod_hang` for example."""
        return str(self.spec.kind)

    @cached_property
    def valid(self) -> Array:
        """Mask of the slots with a sample, bool (slots,)."""
        return self.label("valid")

    @cached_property
    def chosen(self) -> Array:
        """Mask of the samples in the part of the version that the source holds, bool (slots,)."""
        return self.selection.choose_samples(self.arrays.values(), self.label)

    def __len__(self) -> int:
        """Return the number of slots, with the slots of rejected samples."""
        return self.manifest.sample_count

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.source.close()

    def slots(self, split: Split | None = None) -> npt.NDArray[np.int64]:
        """Return the slots of `split`, or of all splits, in increasing order.

        Rejected samples, which have labels only, and those of other parts of the version are left
        out.
        """
        chosen = self.chosen.copy()
        if split is not None:
            if split not in SPLITS:
                raise ValueError(f"split must be one of {', '.join(SPLITS)}, and is {split}")
            chosen &= self.label("split") == SPLITS.index(split)
        return np.flatnonzero(chosen).astype(np.int64)

    def array(self, name: str) -> ArrayLayout:
        """Return the layout of an array; raise ValueError if there is none of this name."""
        try:
            return self.arrays[name]
        except KeyError:
            raise ValueError(
                f"array must be one of {', '.join(self.arrays)}, and is {name}"
            ) from None

    def label(self, name: str) -> Array:
        """Return a label of all slots, read-only: (slots,), or (slots, n) for a small vector."""
        array = self.array(name)
        if not array.is_label:
            raise ValueError(f"{name} is no label; the labels are {', '.join(self.label_names)}")
        return self.index.label(name)

    @property
    def label_names(self) -> tuple[str, ...]:
        return tuple(array.name for array in self.arrays.values() if array.is_label)

    def categories(self, name: str) -> tuple[str, ...]:
        """Return the names of the codes 0, 1, ... of a categorical label.

        The tuple is empty if it is no such label.
        """
        return tuple(map(str, self.array(name).categories))

    def rejections(self) -> Iterator[Rejection]:
        """Yield the rejected samples with their reasons, by slot."""
        with self.index.contents() as contents:
            yield from contents.rejections()

    def files(self) -> Iterator[FileEntry]:
        with self.index.contents() as contents:
            yield from contents.files()

    def read(self, name: str, slots: Slots) -> Array:
        """Return array `name` of the samples in `slots`, (len(slots), *sample shape)."""
        array = self.array(name)
        out = np.empty((len(slots), *array.shape), dtype=array.dtype)
        self.read_into(name, slots, out)
        return out

    def read_into(self, name: str, slots: Slots, out: Array) -> None:
        """Read array `name` of the samples in `slots` into `out`, (len(slots), *sample shape).

        `out` of clips may also have the order in memory that their chunks have, which is quicker.

        Raises:
            ValueError: There is no such array, or `out` has another shape, type or order.
            IndexError: A slot is beyond the end.
            RejectedSampleError: A sample was rejected.
            MissingFileError: A sample is not in the part of the version that the source holds.
            CorruptDataError: A chunk is damaged.
        """
        array = self.array(name)
        shape = (len(slots), *array.shape)
        ordered = out.flags.c_contiguous or (
            out.ndim == len(shape) and in_order_of_chunks(array, out)
        )
        if out.shape != shape or out.dtype != np.dtype(array.dtype) or not ordered:
            raise ValueError(
                f"out must be C-ordered {array.dtype} of shape {shape} for {name}, and is "
                f"{out.dtype} of {out.shape}"
            )
        for place, slot in enumerate(map(int, slots)):
            self._check_slot(slot)
            self.index.read_sample(array, slot, out[place, ...])

    def _check_slot(self, slot: int) -> None:
        if not 0 <= slot < len(self):
            raise IndexError(f"slot must be from 0 to {len(self) - 1}, and is {slot}")
        if not self.valid[slot]:
            reasons = [item for item in self.index.section(slot).rejections if item.slot == slot]
            raise RejectedSampleError(
                f"sample {slot} was rejected: {reasons[0].reason}, {reasons[0].message}"
            )
        if not self.chosen[slot]:
            raise MissingFileError(
                f"sample {slot} is not in the part of the dataset that {self.source} holds: "
                f"{self.selection.model_dump_json()}"
            )

    # --- checks
    # ----------------------------------------------------------------------------------------------

    def verify(self) -> None:
        """Check the size and the SHA-256 of every file of the manifest.

        Opening has checked the manifest itself.
        """
        with self.index.contents() as contents:
            part = part_files(contents, self.selection, self.label)
        for file in part:
            if ".." in file.path.split("/"):
                raise InvalidDatasetError(
                    f"the manifest names {file.path}, which is not inside the dataset"
                )
            self.index.check_file(file)
        for slot in np.flatnonzero(self.chosen).tolist():
            self.index.check_section(slot)

    def _check_metadata(self, group: dict[str, Any]) -> None:
        """Check the Zarr metadata against the layout.

        All reading follows from the layout alone. A chunk of another shape or codec would be
        nonsense that passes its checksum.
        """
        if group.get("zarr_format") != 3 or group.get("node_type") != "group":
            raise InvalidDatasetError(f"{GROUP_NAME} must be of a Zarr v3 group")
        inline = group.get("consolidated_metadata")
        inline = inline.get("metadata") if isinstance(inline, dict) else None
        for name, array in self.arrays.items():
            if isinstance(inline, dict):
                metadata = inline.get(name)
            else:
                file = self.index.file(f"{name}/{GROUP_NAME}", "metadata")
                metadata = _parse_metadata(self.index.read_document(file), self.index.at(file))
            size = self.manifest.spec.samples_per_file(array)
            _check_array(metadata, array, sample_count=len(self), samples_per_file=size)

    def _check_labels(self) -> None:
        """Check that the manifest fits the arrays `valid` and `split`.

        A section is checked when the first of its samples is read.
        """
        for array in self.arrays.values():
            for number in range(
                -(-len(self) // self.manifest.spec.samples_per_file(array)) if array.is_label else 0
            ):
                self.index.file(array.shard_path(number), f"array {array.name}, file {number}")
        if not self.manifest.sections:
            self.index.check_section(0)
        if (valid_count := int(np.count_nonzero(self.valid))) != self.manifest.valid_count:
            raise InvalidDatasetError(
                f"valid_count of the manifest is {self.manifest.valid_count}, and array "
                f"valid has {valid_count}"
            )
        split = self.label("split")
        if split.max() >= len(SPLITS):
            raise InvalidDatasetError(
                f"array split must be less than {len(SPLITS)}, and there is a {split.max()}"
            )
        counts = np.bincount(split[self.valid], minlength=len(SPLITS)).tolist()
        stated = [self.manifest.split_counts.get(name, 0) for name in SPLITS]
        if stated != counts:
            raise InvalidDatasetError(
                f"split_counts of the manifest are {self.manifest.split_counts}, and those "
                "of the arrays "
                f"{dict(zip(SPLITS, counts, strict=True))}"
            )


def _read_sealed(source: Source) -> tuple[str, dict[str, Any], bytes]:
    """Return the manifest's digest, the group's metadata and the manifest's bytes.

    All are checked against one another.
    """
    manifest = source.read_manifest()
    group = source.fetch(GROUP_NAME).data
    try:
        digest = check_seal(manifest, group, source.fetch(SEAL_NAME).data)
    except BrokenSealError as error:
        raise CorruptDataError(f"{source}/{error}") from None
    return digest, _parse_metadata(group, f"{source}/{GROUP_NAME}"), manifest


def _read_selection(source: Source, manifest: str) -> Selection:
    """Return the part of the version with this manifest that the source holds.

    A source may hold all of it.
    """
    if not isinstance(source, DirectorySource):
        return Selection()  # servers have whole versions
    try:
        data = source.fetch(SELECTION_NAME).data
    except MissingFileError:
        return Selection()
    try:
        part = PartDocument.model_validate_json(data)
    except ValidationError as error:
        raise InvalidDatasetError(f"{source}/{SELECTION_NAME} is damaged: {error}") from None
    if part.manifest != manifest:
        raise InvalidDatasetError(
            f"{source}/{SELECTION_NAME} is of another version, whose manifest is {part.manifest}"
        )
    return part.selection


def _parse_manifest(data: bytes) -> Manifest:
    try:
        manifest = Manifest.model_validate_json(data)
    except ValidationError as error:
        raise InvalidDatasetError(f"the manifest does not hold to the contract: {error}") from None
    listed = manifest.sample_count if manifest.sections else len(manifest.sample_keys)
    if listed != manifest.sample_count or manifest.spec.sample_count != manifest.sample_count:
        raise InvalidDatasetError(
            f"sample_count of the manifest is {manifest.sample_count}, its spec asks for "
            f"{manifest.spec.sample_count} "
            f"and it lists {len(manifest.sample_keys)} sample keys"
        )
    return manifest


# --- Zarr metadata
# ----------------------------------------------------------------------------------------------


def _parse_metadata(data: bytes, path: str) -> dict[str, Any]:
    """Return the JSON object in `data`."""
    try:
        metadata = json.loads(data)
    except ValueError as error:
        raise InvalidDatasetError(f"{path} is no JSON: {error}") from None
    if not isinstance(metadata, dict):
        raise InvalidDatasetError(
            f"{path} must be a JSON object, and is a {type(metadata).__name__}"
        )
    return metadata


def _check_array(
    metadata: Any, array: ArrayLayout, *, sample_count: int, samples_per_file: int
) -> None:
    """Raise InvalidDatasetError if the metadata of one array contradict its layout."""
    if not isinstance(metadata, dict):
        raise InvalidDatasetError(f"array {array.name}: there must be metadata, and there are none")
    shard = [samples_per_file, *array.shape]
    expected: dict[str, Any] = {
        "zarr_format": 3,
        "node_type": "array",
        "shape": [sample_count, *array.shape],
        "data_type": array.dtype,
        "dimension_names": ["sample", *array.dimensions],
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": shard}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "codecs": _codecs(array),
        "fill_value": "NaN" if array.fill != array.fill else array.fill,
        "storage_transformers": [],
    }
    defaults = _DEFAULTS | (
        {"bytes": {"endian": "little"}} if np.dtype(array.dtype).itemsize == 1 else {}
    )
    stated = {
        **metadata,
        "chunk_key_encoding": _normalised(metadata.get("chunk_key_encoding"), defaults),
        "codecs": _normalised(metadata.get("codecs"), defaults),
        "storage_transformers": metadata.get("storage_transformers") or [],
    }
    for field, rule in expected.items():
        if stated.get(field) != rule:
            raise InvalidDatasetError(
                f"array {array.name}: {field} must be {json.dumps(rule)}, and is "
                f"{json.dumps(stated.get(field))}"
            )


_LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}
_CRC = {"name": "crc32c", "configuration": {}}


def _codecs(array: ArrayLayout) -> list[dict[str, Any]]:
    compressor: dict[str, Any] = {
        "name": "zstd" if packing(array) is None else "blosc",
        "configuration": {},
    }
    chunk: list[dict[str, Any]] = [_LITTLE, compressor, _CRC]
    if (order := axes_order(array)) is not None:
        chunk.insert(0, {"name": "transpose", "configuration": {"order": list(order)}})
    if not array.per_sample:
        return chunk
    configuration = {
        "chunk_shape": [1, *array.shape],
        "codecs": chunk,
        "index_codecs": [_LITTLE, _CRC],
        "index_location": "end",
    }
    return [{"name": "sharding_indexed", "configuration": configuration}]


_DEFAULTS = {"default": {"separator": "/"}, "sharding_indexed": {"index_location": "end"}}
"""Configurations that the metadata may leave out; for values of one byte, the order of bytes, too.
"""


def _normalised(codec: Any, defaults: Mapping[str, dict[str, str]]) -> Any:
    """Give a codec or an encoding, or each of a list, its configuration.

    A reader need not know the level of zstd, nor anything about blosc: they are left out.
    """
    if isinstance(codec, list):
        return [_normalised(each, defaults) for each in codec]
    codec = {"name": codec} if isinstance(codec, str) else codec
    if not isinstance(codec, dict):
        return codec
    name = codec.get("name")
    configuration = defaults.get(str(name), {}) | (codec.get("configuration") or {})
    nested = [key for key in ("codecs", "index_codecs") if key in configuration]
    inner = {key: _normalised(configuration[key], defaults) for key in nested}
    return {
        "name": name,
        "configuration": {} if name in ("zstd", "blosc") else configuration | inner,
    }
