"""Index of a version: the place of each sample in its files, and reading.

A file holds labels, curves of many samples a chunk, or one chunk a sample.

A read of bytes per clip, mesh or set of views: shard indexes are kept, a chunk's crc32c is checked,
and it is decoded into its place in the caller's buffer.
"""

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from stickslip_schemas.base import sha256
from stickslip_schemas.format import codecs
from stickslip_schemas.format.manifest import (
    BrokenSectionError,
    Contents,
    FileEntry,
    Manifest,
    ManifestSection,
)
from stickslip_schemas.spec.arrays import ArrayLayout

from stickslip_training.arrays import Array
from stickslip_training.data.sources import (
    CorruptDataError,
    InvalidDatasetError,
    MissingFileError,
    Source,
)


class Index:
    """The files of a version.

    A file that is read whole is checked against its digest, and so is the shard of a directory
    before the first of its samples is read.
    """

    def __init__(
        self,
        source: Source,
        manifest: Manifest,
        arrays: Mapping[str, ArrayLayout],
        *,
        check_shards: bool,
        cache_bytes: int,
    ) -> None:
        self.source = source
        self.manifest = manifest
        self.arrays = arrays
        self._check_shards = check_shards
        self._contents = Contents(manifest, source.read_document)
        self._checked_sections: set[int] = set()
        self._shard_indexes: dict[tuple[str, int], Array] = {}
        self._labels: dict[str, Array] = {}
        self._chunks: OrderedDict[tuple[str, int], Array] = OrderedDict()
        """Decoded chunks of many samples, in the order of their last use."""
        self._chunk_bytes = 0
        self._cache_bytes = cache_bytes

    def __getstate__(self) -> dict[str, Any]:
        # The types of a spec's axes are made at run time, and pickle cannot find them by name.
        return self.__dict__ | {"manifest": self.manifest.model_dump_json(), "_contents": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        manifest = Manifest.model_validate_json(state["manifest"])
        self.__dict__.update(
            state, manifest=manifest, _contents=Contents(manifest, state["source"].read_document)
        )

    # --- files
    # ----------------------------------------------------------------------------------------------

    @contextmanager
    def contents(self) -> Iterator[Contents]:
        """Yield the manifest's contents; a broken section then raises CorruptDataError."""
        try:
            yield self._contents
        except BrokenSectionError as error:
            raise CorruptDataError(f"{self.source}/{error}") from error

    def section(self, slot: int) -> ManifestSection:
        with self.contents() as contents:
            return contents.section(contents.number_of(slot))

    def file(self, path: str, subject: str) -> FileEntry:
        """Return a file of the manifest; MissingFileError begins with `subject`."""
        with self.contents() as contents:
            file = contents.file(path)
        if file is None:
            raise MissingFileError(f"{subject}: {path} is not in the manifest of {self.source}")
        return file

    def read_file(self, file: FileEntry) -> bytes:
        """Return a whole file, checked against its digest."""
        data = self.source.read(file)
        self._compare(file, sha256(data))
        return data

    def read_document(self, file: FileEntry) -> bytes:
        """Return a JSON document of the manifest's files, checked against its digest."""
        data = self.source.read_document(file)
        self._compare(file, sha256(data))
        return data

    def check_file(self, file: FileEntry) -> None:
        """Check the size and the digest of a file; it is read in blocks."""
        self._compare(file, self.source.computed_digest(file))

    def at(self, file: FileEntry) -> str:
        """Return the path or URL of a file, for messages."""
        return f"{self.source}/{file.path}"

    def _compare(self, file: FileEntry, digest: str | None) -> None:
        if digest is not None and digest != file.sha256:
            raise CorruptDataError(
                f"{self.at(file)} has SHA-256 {digest}, and the manifest says {file.sha256}"
            )

    def check_section(self, slot: int) -> None:
        """Check that the section of a sample fits the labels, and lists all shards.

        Each shard with a valid sample must be listed.
        """
        number = self._contents.number_of(slot)
        if number in self._checked_sections:
            return
        section = self.section(slot)
        slots = slice(section.first, section.end)
        valid = self.label("valid")[slots]
        rejected = sorted(item.slot for item in section.rejections)
        if (section.first + np.flatnonzero(~valid)).tolist() != rejected:
            raise InvalidDatasetError(
                f"array valid must be false at the manifest's rejections, which are {rejected}"
            )
        keys = self.label("sample_key")[slots]
        listed = np.frombuffer(bytes.fromhex("".join(section.sample_keys)), dtype=np.uint8).reshape(
            keys.shape
        )
        wrong = section.first + np.flatnonzero(valid & (keys != listed).any(axis=1))
        if wrong.size:
            raise InvalidDatasetError(
                f"array sample_key is not what the manifest says of samples {wrong.tolist()}"
            )
        # A missing shard raises now, and not in the middle of an epoch.
        shards = (section.first + np.flatnonzero(valid)) // self.manifest.spec.samples_per_shard
        for shard in np.unique(shards).tolist():
            for array in self.arrays.values():
                if not array.is_label:
                    self.file(array.shard_path(shard), f"array {array.name}, shard {shard}")
        self._checked_sections.add(number)

    # --- arrays
    # ----------------------------------------------------------------------------------------------

    def label(self, name: str) -> Array:
        """Return a label of all slots, (slots, ...), read-only."""
        if name not in self._labels:
            array = self.arrays[name]
            count = self.manifest.sample_count
            numbers = range(-(-count // self.manifest.spec.samples_per_file(array)))
            values = np.concatenate([self._read_chunk(array, number) for number in numbers])[:count]
            values.flags.writeable = False
            self._labels[name] = values
        return self._labels[name]

    def read_sample(self, array: ArrayLayout, slot: int, out: Array) -> None:
        """Read a valid sample of an array into `out`, (*sample shape)."""
        self.check_section(slot)
        number, position = divmod(slot, self.manifest.spec.samples_per_file(array))
        if not array.per_sample:
            out[...] = self._kept_chunk(array, number)[position]
            return
        subject = f"array {array.name}, sample {slot}"
        file = self.file(array.shard_path(number), subject)
        offset, length = map(int, self._shard_index(array, number, file)[position])
        if offset == codecs.MISSING and length == codecs.MISSING:
            raise CorruptDataError(f"{subject}: its chunk is missing in {self.at(file)}")
        if offset + length > file.size:
            raise CorruptDataError(
                f"{subject}: its chunk reaches beyond the end of {self.at(file)}"
            )
        # A chunk is read whole, so its size must be one that the sample can have.
        if length > codecs.largest_chunk(out.nbytes):
            raise CorruptDataError(
                f"{subject}: its chunk has {length} bytes, more than {out.nbytes} can take"
            )
        chunk = self.source.read(file, offset, length)
        with _naming(f"{subject}, {self.at(file)}"):
            codecs.decode_sample(array, chunk, out)

    def _shard_index(self, array: ArrayLayout, shard: int, file: FileEntry) -> Array:
        key = array.name, shard
        if key not in self._shard_indexes:
            samples = self.manifest.spec.samples_per_shard
            size = codecs.shard_index_size(samples)
            if size > file.size:
                raise CorruptDataError(
                    f"array {array.name}: {self.at(file)} is too short for a shard index"
                )
            data = self.source.read(file, file.size - size, size)
            if self._check_shards:
                self._compare(file, self.source.digest(file))
            with _naming(f"array {array.name}, {self.at(file)}"):
                self._shard_indexes[key] = codecs.decode_shard_index(data, samples)
        return self._shard_indexes[key]

    def _kept_chunk(self, array: ArrayLayout, number: int) -> Array:
        key = array.name, number
        if key not in self._chunks:
            self._chunks[key] = self._read_chunk(array, number)
            self._chunk_bytes += self._chunks[key].nbytes
            while self._chunk_bytes > self._cache_bytes and len(self._chunks) > 1:
                self._chunk_bytes -= self._chunks.popitem(last=False)[1].nbytes
        self._chunks.move_to_end(key)
        return self._chunks[key]

    def _read_chunk(self, array: ArrayLayout, number: int) -> Array:
        """Return the chunk that is all of a file, (samples per file, *sample shape)."""
        size = self.manifest.spec.samples_per_file(array)
        last = min((number + 1) * size, self.manifest.sample_count) - 1
        subject = f"array {array.name}, samples {number * size} to {last}"
        file = self.file(array.shard_path(number), subject)
        out = np.empty((size, *array.shape), dtype=array.dtype)
        # The size is checked before the file is read: memory follows from the layout.
        if file.size > codecs.largest_chunk(out.nbytes):
            raise CorruptDataError(
                f"{subject}: {self.at(file)} has {file.size} bytes, more than {out.nbytes} can take"
            )
        data = self.read_file(file)
        with _naming(f"{subject}, {self.at(file)}"):
            codecs.decode_chunk(data, out)
        return out


@contextmanager
def _naming(subject: str) -> Iterator[None]:
    """Name the chunk that cannot be decoded."""
    try:
        yield
    except (codecs.CorruptChunkError, RuntimeError, ValueError) as error:
        raise CorruptDataError(f"{subject}: {error}") from error
