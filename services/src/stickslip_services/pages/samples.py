"""Arrays of single samples, read from the shards in the store."""

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base import Sha256
from stickslip_schemas.format.codecs import (
    MISSING,
    decode_chunk,
    decode_sample,
    decode_shard_index,
    shard_index_size,
)
from stickslip_schemas.format.manifest import Contents, FileEntry, Rejection, layout
from stickslip_schemas.kinds.cloth.arrays import PICTURE_SIZE
from stickslip_schemas.spec.arrays import ArrayLayout
from stickslip_schemas.store import Store

Array = npt.NDArray[np.generic]

CACHED_BYTES = 2**26
"""Largest value of a sample that is kept for the next request [bytes]."""


class SampleData:
    """The arrays of a version by name, whose files the manifest lists."""

    def __init__(self, store: Store, contents: Contents) -> None:
        self.store = store
        self.contents = contents
        self.manifest = contents.manifest
        self.arrays = {array.name: array for array in layout(self.manifest.spec)}

    def read(self, name: str, slot: int) -> Array:
        """Return the value of an array for a sample.

        Raise KeyError for a rejected sample, OSError or CorruptChunkError for a damaged file.
        """
        array = self.arrays[name]
        samples_per_file = self.manifest.spec.samples_per_file(array)
        number, position = divmod(slot, samples_per_file)
        file = self._file(array, number)
        if array.per_sample:
            # Large pictures are not kept, or a few of them would fill the memory.
            read = _chunk if array.sample_bytes <= CACHED_BYTES else _decoded
            return read(self.store, file, array, position, samples_per_file)
        # A label has one file for many samples, which is cached as a whole.
        column = _column(self.store, file.sha256, array, samples_per_file)
        return np.asarray(column[position])

    def picture_size(self, slot: int) -> Array | None:
        """Return width and height of the pictures of a sample [px], or None if they fill frames."""
        return self.read(PICTURE_SIZE.name, slot) if PICTURE_SIZE.name in self.arrays else None

    def label(self, name: str) -> Array:
        """Return the values of a label for all samples, by slot."""
        array = self.arrays[name]
        samples_per_file = self.manifest.spec.samples_per_file(array)
        file_count = -(-self.manifest.sample_count // samples_per_file)
        columns = [
            _column(self.store, self._file(array, number).sha256, array, samples_per_file)
            for number in range(file_count)
        ]
        return np.concatenate(columns)[: self.manifest.sample_count]

    def rejection(self, slot: int) -> Rejection | None:
        """Return the rejection of a sample, None for a valid one."""
        rejections = self.contents.section(self.contents.number_of(slot)).rejections
        return next((rejection for rejection in rejections if rejection.slot == slot), None)

    def named(self, array: ArrayLayout, value: Array) -> object:
        """Return a label for display: the name of a code, a number, or several numbers."""
        if array.categories:
            code = int(value)
            is_known = 0 <= code < len(array.categories)
            return array.categories[code] if is_known else "none"
        if value.ndim == 0:
            return value.item()
        return ", ".join(f"{item:.4g}" for item in value.ravel())

    def _file(self, array: ArrayLayout, number: int) -> FileEntry:
        path = array.shard_path(number)
        file = self.contents.file(path)
        if file is None:
            raise KeyError(path)
        return file


def _decoded(store: Store, file: FileEntry, array: ArrayLayout, position: int, slots: int) -> Array:
    """Return the value of the sample at `position` of a shard.

    Raise KeyError if the sample was rejected.
    """
    # The index at the end of a shard has offset and length of each chunk, so that one sample is
    # read without the others.
    index_bytes = shard_index_size(slots)
    tail = store.read(file.sha256, offset=file.size - index_bytes, length=index_bytes)
    offset, length = (int(value) for value in decode_shard_index(tail, slots)[position])
    if offset == MISSING:
        raise KeyError(array.name)
    chunk = store.read(file.sha256, offset=offset, length=length)
    value = np.empty(array.shape, dtype=array.dtype)
    decode_sample(array, chunk, value)
    return value


_chunk = lru_cache(maxsize=4)(_decoded)
"""The same, with the last values kept: a page asks for one frame after the other."""


@lru_cache(maxsize=256)
def _column(store: Store, digest: Sha256, array: ArrayLayout, slots: int) -> Array:
    """Return the values of all samples of a file. Artifacts never change, so they are cached."""
    values = np.empty((slots, *array.shape), dtype=array.dtype)
    decode_chunk(store.read(digest), values)
    return values
