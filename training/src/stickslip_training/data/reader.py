"""Read a dataset version, from a directory or over HTTP, into NumPy arrays.

One read of bytes per clip, mesh or set of views: shard indexes are kept, a chunk's crc32c is checked, and it is
decoded straight into its place in the caller's buffer. There are no threads and nothing asynchronous, so a reader may
be used before and after a fork, and it can be pickled. Zeros are never made up: what cannot be read raises.
"""

import os
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError
from stickslip_schemas.base.keys import sha256
from stickslip_schemas.format.chunks import (
    MISSING,
    CorruptChunkError,
    decode_chunk,
    decode_shard_index,
    shard_index_size,
)
from stickslip_schemas.format.codecs import decode_sample, empty_in_order, in_order_of_chunks
from stickslip_schemas.format.layout import layout
from stickslip_schemas.format.manifest import BrokenSectionError, Contents, FileEntry, Manifest, Rejection
from stickslip_schemas.format.selection import part_files
from stickslip_schemas.spec.arrays import SPLITS, ArrayLayout
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_training.arrays import Array
from stickslip_training.data.errors import (
    CorruptDataError,
    InvalidDatasetError,
    MissingFileError,
    RejectedSampleError,
)
from stickslip_training.data.metadata import GROUP_METADATA, check_array, consolidated, parse_metadata
from stickslip_training.data.seal import read_sealed, read_selection
from stickslip_training.data.sources import open_source

Split = Literal["train", "validation", "test"]
Slots = Sequence[int] | npt.NDArray[np.integer[Any]]


class DatasetReader:
    """One version of a dataset. Samples are named by their slot, 0 to `len(reader)` - 1."""

    def __init__(
        self,
        source: str | os.PathLike[str],
        *,
        api_key: str | None = None,
        verify: bool = False,
        check_shards: bool = True,
        cache_bytes: int = 256 * 2**20,
    ) -> None:
        """Open `source`: the directory of a version, or its URL (see `sources.HttpSource`).

        The manifest and the metadata are checked against their digests here. A file that is read whole is checked
        when it is read, a shard in a directory before the first of its samples is; `check_shards=False` leaves the
        latter out. Over HTTP, samples are parts of shards, and only `verify` checks them against the manifest: it
        reads every file first. Curves and labels come many samples to a chunk; decoded chunks of curves are kept up
        to `cache_bytes`.
        """
        self._check_shards = check_shards
        self.source = open_source(source, api_key=api_key)
        try:
            self._open(cache_bytes, verify)
        except BaseException:
            self.close()
            raise

    def _open(self, cache_bytes: int, verify: bool) -> None:
        self.manifest_digest, self._group, manifest = read_sealed(self.source)
        self.manifest = _parse_manifest(manifest)
        self.selection = read_selection(self.source, self.manifest_digest)
        arrays = self.selection.choose_arrays(layout(self.spec))
        self.arrays: dict[str, ArrayLayout] = {array.name: array for array in arrays}
        self._chosen: Array | None = None
        self._contents = self._read_contents()
        self._checked: set[int] = set()
        """Sections of the manifest that tell the same as the labels."""
        self._shard_size = self.spec.samples_per_shard
        self._indexes: dict[tuple[str, int], Array] = {}
        self._labels: dict[str, Array] = {}
        self._chunks: OrderedDict[tuple[str, int], Array] = OrderedDict()
        self._chunk_bytes = 0
        self._cache_bytes = cache_bytes
        if verify:
            self.verify()
        self._check_metadata()
        self._check_slots()

    @property
    def spec(self) -> JobSpec:
        """What was asked for when the dataset was made."""
        return self.manifest.spec

    @property
    def kind(self) -> str:
        """The kind of the dataset, `rod_hang` for example."""
        return str(self.spec.kind)

    @property
    def valid(self) -> Array:
        """True where there is a sample, bool (slots,)."""
        return self.label("valid")

    @property
    def chosen(self) -> Array:
        """True where there is a sample and it is in the part of the version that the source holds, bool (slots,)."""
        if self._chosen is None:
            self._chosen = self.selection.choose_samples(self.arrays.values(), self.label)
        return self._chosen

    def __len__(self) -> int:
        """Return the number of slots, those of rejected samples included."""
        return self.manifest.sample_count

    def __enter__(self) -> "DatasetReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        # The types of a spec's axes are made at run time, and pickle cannot find them by name.
        return self.__dict__ | {"manifest": self.manifest.model_dump_json(), "_contents": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, manifest=Manifest.model_validate_json(state["manifest"]))
        self._contents = self._read_contents()

    def close(self) -> None:
        """Let go of connections."""
        self.source.close()

    # --- what there is ----------------------------------------------------------------------------------------

    def slots(self, split: Split | None = None, *, rejected: bool = False) -> npt.NDArray[np.int64]:
        """Return the slots of `split`, or of all splits, in increasing order.

        Rejected samples are left out, and those that are not in the part of the version that the source holds. With
        `rejected` all slots are in; rejected samples have their parameters as labels, and reading anything else of
        them raises.
        """
        chosen = np.ones(len(self), dtype=bool) if rejected else self.chosen.copy()
        if split is not None:
            if split not in SPLITS:
                raise ValueError(f"split must be one of {', '.join(SPLITS)}, and is {split!r}")
            chosen &= self.label("split") == SPLITS.index(split)
        return np.flatnonzero(chosen).astype(np.int64)

    def label(self, name: str) -> Array:
        """Return a label of all slots, (slots,), or (slots, n) for one that is a small vector; read-only."""
        if name not in self._labels:
            array = self._array(name)
            if array.per_sample or len(array.shape) > 1:
                raise ValueError(f"{name} is no label; the labels are {', '.join(self.label_names)}")
            numbers = range(-(-len(self) // self.manifest.samples_per_file(array)))
            values = np.concatenate([self._read_group_chunk(array, number) for number in numbers])[: len(self)]
            values.flags.writeable = False
            self._labels[name] = values
        return self._labels[name]

    @property
    def label_names(self) -> tuple[str, ...]:
        """Names of the labels."""
        return tuple(array.name for array in self.arrays.values() if not array.per_sample and len(array.shape) < 2)

    def categories(self, name: str) -> tuple[str, ...]:
        """Return the names of the codes 0, 1, ... of a categorical label; none where it is no such label."""
        return tuple(map(str, self._array(name).categories))

    def rejections(self) -> Iterator[Rejection]:
        """Yield the rejected samples with their reasons, by slot."""
        with self._telling_sections():
            yield from self._contents.rejections()

    def files(self) -> Iterator[FileEntry]:
        """Yield the files that the manifest lists."""
        with self._telling_sections():
            yield from self._contents.files()

    # --- samples ----------------------------------------------------------------------------------------------

    def read(self, name: str, slots: Slots) -> Array:
        """Return array `name` of the samples in `slots`, (len(slots), *sample shape)."""
        array = self._array(name)
        out = np.empty((len(slots), *array.shape), dtype=array.dtype)
        self.read_into(name, slots, out)
        return out

    def read_into(self, name: str, slots: Slots, out: Array) -> None:
        """Read array `name` of the samples in `slots` into `out`, C-ordered, (len(slots), *sample shape).

        `out` of clips may also have the order in memory that their chunks have, which is quicker: see `empty`.
        """
        array = self._array(name)
        shape = (len(slots), *array.shape)
        ordered = out.flags.c_contiguous or (out.ndim == len(shape) and in_order_of_chunks(array, out))
        if out.shape != shape or out.dtype != np.dtype(array.dtype) or not ordered:
            raise ValueError(
                f"out must be C-ordered {array.dtype} of shape {shape} for {name}, and is {out.dtype} of {out.shape}"
            )
        for place, slot in enumerate(map(int, slots)):
            self._check_slot(slot)
            self._check_section(self._contents.number_of(slot))
            number, position = divmod(slot, self.manifest.samples_per_file(array))
            if array.per_sample:
                self._read_sample(array, number, position, slot, out[place])
            else:
                out[place] = self._group_chunk(array, number)[position]

    def empty(self, name: str, count: int) -> Array:
        """Return an array for `count` samples, with its axes in memory as chunks have them: C-ordered but for clips."""
        return empty_in_order(self._array(name), count)

    def verify(self) -> None:
        """Check the size and the SHA-256 of every file of the manifest; the others were checked when it was opened."""
        with self._telling_sections():
            part = part_files(self._contents, self.selection, self.label)
        for file in part:
            if ".." in file.path.split("/"):
                raise InvalidDatasetError(f"the manifest names {file.path}, which is not inside the dataset")
            self._check_digest(file, self.source.read(file))
        for number in {self._contents.number_of(slot) for slot in np.flatnonzero(self.chosen).tolist()}:
            self._check_section(number)

    # --- chunks -----------------------------------------------------------------------------------------------

    def _read_sample(self, array: ArrayLayout, shard: int, position: int, slot: int, out: Array) -> None:
        file = self._file(array.shard_path(shard), f"array {array.name}, sample {slot}")
        offset, length = map(int, self._shard_index(array, shard, file)[position])
        if offset == MISSING and length == MISSING:
            raise CorruptDataError(f"array {array.name}, sample {slot}: its chunk is missing in {self._at(file)}")
        if offset + length > file.size:
            raise CorruptDataError(
                f"array {array.name}, sample {slot}: its chunk reaches beyond the end of {self._at(file)}"
            )
        chunk = self.source.read(file, offset, length)
        with _naming(f"array {array.name}, sample {slot}, {self._at(file)}"):
            decode_sample(array, chunk, out)

    def _shard_index(self, array: ArrayLayout, shard: int, file: FileEntry) -> Array:
        key = array.name, shard
        if key not in self._indexes:
            if self._check_shards:
                self._check_file(file)
            size = shard_index_size(self._shard_size)
            if size > file.size:
                raise CorruptDataError(f"array {array.name}: {self._at(file)} is too short for a shard index")
            try:
                index = decode_shard_index(self.source.read(file, file.size - size, size), self._shard_size)
            except CorruptChunkError as error:
                raise CorruptDataError(f"array {array.name}, {self._at(file)}: {error}") from error
            self._indexes[key] = index
        return self._indexes[key]

    def _group_chunk(self, array: ArrayLayout, shard: int) -> Array:
        key = array.name, shard
        chunk = self._chunks.get(key)
        if chunk is None:
            chunk = self._chunks[key] = self._read_group_chunk(array, shard)
            self._chunk_bytes += chunk.nbytes
            while self._chunk_bytes > self._cache_bytes and len(self._chunks) > 1:
                self._chunk_bytes -= self._chunks.popitem(last=False)[1].nbytes
        else:
            self._chunks.move_to_end(key)
        return chunk

    def _read_group_chunk(self, array: ArrayLayout, number: int) -> Array:
        """Return the chunk that is all of a file, (samples per file, *sample shape)."""
        size = self.manifest.samples_per_file(array)
        first, end = number * size, min((number + 1) * size, len(self))
        file = self._file(array.shard_path(number), f"array {array.name}, samples {first} to {end - 1}")
        out = np.empty((size, *array.shape), dtype=array.dtype)
        data = self.source.read(file)
        self._check_digest(file, data)
        with _naming(f"array {array.name}, samples {first} to {end - 1}, {self._at(file)}"):
            decode_chunk(data, out)
        return out

    def _at(self, file: FileEntry) -> str:
        return f"{self.source}/{file.path}"

    def _file(self, path: str, what: str) -> FileEntry:
        with self._telling_sections():
            file = self._contents.file(path)
        if file is None:
            raise MissingFileError(f"{what}: {path} is not in the manifest of {self.source}")
        return file

    def _read_contents(self) -> Contents:
        return Contents(self.manifest, self.source.read)

    @contextmanager
    def _telling_sections(self) -> Iterator[None]:
        try:
            yield
        except BrokenSectionError as error:
            raise CorruptDataError(f"{self.source}/{error}") from error

    def _array(self, name: str) -> ArrayLayout:
        try:
            return self.arrays[name]
        except KeyError:
            raise ValueError(f"array must be one of {', '.join(self.arrays)}, and is {name!r}") from None

    def _check_slot(self, slot: int) -> None:
        if not 0 <= slot < len(self):
            raise IndexError(f"slot must be from 0 to {len(self) - 1}, and is {slot}")
        if not self.valid[slot]:
            with self._telling_sections():
                section = self._contents.section(self._contents.number_of(slot))
            reasons = [item for item in section.rejections if item.slot == slot]
            raise RejectedSampleError(f"sample {slot} was rejected: {reasons[0].reason}, {reasons[0].message}")
        if not self.chosen[slot]:
            raise MissingFileError(
                f"sample {slot} is not in the part of the dataset that {self.source} holds: "
                f"{self.selection.model_dump_json()}"
            )

    # --- checks at open ---------------------------------------------------------------------------------------

    def _check_metadata(self) -> None:
        """Check the Zarr metadata against the layout, and their digests against the manifest."""
        inline = consolidated(self._group)
        for name, array in self.arrays.items():
            found = self._read_metadata(f"{name}/{GROUP_METADATA}") if inline is None else inline.get(name)
            check_array(found, array, sample_count=len(self), samples_per_file=self.manifest.samples_per_file(array))

    def _read_metadata(self, path: str) -> dict[str, Any]:
        file = self._file(path, "metadata")
        data = self.source.read(file)
        self._check_digest(file, data)
        return parse_metadata(data, self._at(file))

    def _check_file(self, file: FileEntry) -> None:
        """Check the SHA-256 of a file of which only a part will be read."""
        self._compare(file, self.source.digest(file))

    def _check_digest(self, file: FileEntry, data: bytes) -> None:
        self._compare(file, sha256(data))

    def _compare(self, file: FileEntry, digest: str | None) -> None:
        if digest is not None and digest != file.sha256:
            raise CorruptDataError(f"{self._at(file)} has SHA-256 {digest}, and the manifest says {file.sha256}")

    def _check_slots(self) -> None:
        """Check that the manifest and the arrays `valid`, `split` and `sample_key` tell one story.

        What sections say of their samples is checked when the first of these is read.
        """
        for array in self.arrays.values():
            for number in range(-(-len(self) // self.manifest.samples_per_file(array)) if array.is_label else 0):
                self._file(array.shard_path(number), f"array {array.name}, file {number}")
        if not self.manifest.sections:
            self._check_section(0)
        if (valid_count := int(np.count_nonzero(self.valid))) != self.manifest.valid_count:
            raise InvalidDatasetError(
                f"valid_count of the manifest is {self.manifest.valid_count}, and array valid has {valid_count}"
            )
        split = self.label("split")
        if split.max() >= len(SPLITS):
            raise InvalidDatasetError(f"array split must be less than {len(SPLITS)}, and there is a {split.max()}")
        counts = np.bincount(split[self.valid], minlength=len(SPLITS)).tolist()
        stated = [self.manifest.split_counts.get(name, 0) for name in SPLITS]
        if stated != counts:
            raise InvalidDatasetError(
                f"split_counts of the manifest are {self.manifest.split_counts}, and those of the arrays "
                f"{dict(zip(SPLITS, counts, strict=True))}"
            )

    def _check_section(self, number: int) -> None:
        """Check that a section of the manifest and the labels say the same, and that it lists what it has to."""
        if number in self._checked:
            return
        with self._telling_sections():
            section = self._contents.section(number)
        slots = slice(section.first, section.end)
        valid = self.valid[slots]
        rejected = sorted(item.slot for item in section.rejections)
        if (section.first + np.flatnonzero(~valid)).tolist() != rejected:
            raise InvalidDatasetError(f"array valid must be false at the manifest's rejections, which are {rejected}")
        keys = self.label("sample_key")[slots]
        listed = np.frombuffer(bytes.fromhex("".join(section.sample_keys)), dtype=np.uint8).reshape(keys.shape)
        wrong = section.first + np.flatnonzero(valid & (keys != listed).any(axis=1))
        if wrong.size:
            raise InvalidDatasetError(f"array sample_key is not what the manifest says of samples {wrong.tolist()}")
        # Every shard that holds a valid sample must be listed: better now than when an epoch is half over.
        for shard in np.unique((section.first + np.flatnonzero(valid)) // self._shard_size).tolist():
            for array in self.arrays.values():
                if not array.is_label:
                    self._file(array.shard_path(shard), f"array {array.name}, shard {shard}")
        self._checked.add(number)


def _parse_manifest(data: bytes) -> Manifest:
    try:
        manifest = Manifest.model_validate_json(data)
    except ValidationError as error:
        raise InvalidDatasetError(f"the manifest does not hold to the contract: {error}") from None
    listed = manifest.sample_count if manifest.sections else len(manifest.sample_keys)
    if listed != manifest.sample_count or manifest.spec.sample_count != manifest.sample_count:
        raise InvalidDatasetError(
            f"sample_count of the manifest is {manifest.sample_count}, its spec asks for {manifest.spec.sample_count} "
            f"and it lists {len(manifest.sample_keys)} sample keys"
        )
    if not manifest.sections and manifest.valid_count != manifest.sample_count - len(manifest.rejections):
        raise InvalidDatasetError(
            f"valid_count of the manifest is {manifest.valid_count}, and {manifest.sample_count} samples less "
            f"{len(manifest.rejections)} rejections is another number"
        )
    return manifest


@contextmanager
def _naming(what: str) -> Iterator[None]:
    """Say of a chunk that cannot be decoded which one it is."""
    try:
        yield
    except (CorruptChunkError, RuntimeError, ValueError) as error:
        raise CorruptDataError(f"{what}: {error}") from error
