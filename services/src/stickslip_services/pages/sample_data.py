"""Arrays of single samples, read from the shards in the store."""

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base import Sha256
from stickslip_schemas.format.codecs import MISSING, decode_chunk, decode_sample, decode_shard_index, shard_index_size
from stickslip_schemas.format.manifest import Contents, FileEntry, Rejection, layout
from stickslip_schemas.spec.arrays import ArrayLayout
from stickslip_schemas.store import Store

Array = npt.NDArray[np.generic]


class SampleData:
    """The arrays of a version by name, whose files the manifest lists."""

    def __init__(self, store: Store, contents: Contents) -> None:
        self.contents = contents
        self.manifest = manifest = contents.manifest
        self.arrays = {array.name: array for array in layout(manifest.spec)}
        self.store = store

    def read(self, name: str, slot: int) -> Array:
        """Return the value of an array for a sample; raise KeyError, OSError or CorruptChunkError."""
        array = self.arrays[name]
        size = self.manifest.spec.samples_per_file(array)
        file = self._file(array, slot // size)
        return (
            _chunk(self.store, file, array, slot % size, size)
            if array.per_sample
            else _column(self.store, file.sha256, array, size)[slot % size]
        )

    def label(self, name: str) -> Array:
        array = self.arrays[name]
        size = self.manifest.spec.samples_per_file(array)
        files = (self._file(array, number) for number in range(-(-self.manifest.sample_count // size)))
        columns = [_column(self.store, file.sha256, array, size) for file in files]
        return np.concatenate(columns)[: self.manifest.sample_count]

    def rejection(self, slot: int) -> Rejection | None:
        """Return the rejection of a sample, None for a valid one."""
        rejections = self.contents.section(self.contents.number_of(slot)).rejections
        return next((rejection for rejection in rejections if rejection.slot == slot), None)

    def _file(self, array: ArrayLayout, number: int) -> FileEntry:
        path = array.shard_path(number)
        file = self.contents.file(path)
        if file is None:
            raise KeyError(path)
        return file

    def named(self, array: ArrayLayout, value: Array) -> object:
        """Return a label for display: the name of a code, a number, or several numbers."""
        if array.categories:
            code = int(value)
            return array.categories[code] if 0 <= code < len(array.categories) else "none"
        return value.item() if value.ndim == 0 else ", ".join(f"{item:.4g}" for item in value.ravel())


@lru_cache(maxsize=4)
def _chunk(store: Store, file: FileEntry, array: ArrayLayout, position: int, slots: int) -> Array:
    """Return the value of the sample at `position` of a shard; raise KeyError if it was rejected."""
    tail = shard_index_size(slots)
    index = decode_shard_index(store.read(file.sha256, offset=file.size - tail, length=tail), slots)
    offset, length = (int(value) for value in index[position])
    if offset == MISSING:
        raise KeyError(array.name)
    chunk = store.read(file.sha256, offset=offset, length=length)
    out = np.empty(array.shape, dtype=array.dtype)
    decode_sample(array, chunk, out)
    return out


@lru_cache(maxsize=256)
def _column(store: Store, digest: Sha256, array: ArrayLayout, slots: int) -> Array:
    """Return the values of all samples of a file. Artifacts never change, so they are cached."""
    out = np.empty((slots, *array.shape), dtype=array.dtype)
    decode_chunk(store.read(digest), out)
    return out
