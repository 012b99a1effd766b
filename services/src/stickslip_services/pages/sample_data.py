"""What a page shows of one sample: its arrays, read from the shards in the store."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from stickslip_schemas.arrays import ArrayLayout
from stickslip_schemas.chunks import (
    MISSING,
    decode_chunk,
    decode_shard_index,
    shard_index_size,
)
from stickslip_schemas.codecs import decode_sample
from stickslip_schemas.layout import layout
from stickslip_schemas.manifest import Manifest
from stickslip_schemas.store import Store

Array = npt.NDArray[np.generic]


class SampleData:
    """The arrays of a version, by name; the files are found through its manifest."""

    def __init__(self, store: Store, manifest: Manifest) -> None:
        self.manifest = manifest
        self.arrays = {array.name: array for array in layout(manifest.spec)}
        self._store = store
        self._digests = {file.path: file.sha256 for file in manifest.files}

    def read(self, name: str, slot: int) -> Array:
        """Return the value of an array for a sample; raise KeyError, OSError or CorruptChunkError."""
        array = self.arrays[name]
        size = self.manifest.spec.samples_per_shard
        path = self._store.path(self._digests[array.shard_path(slot // size)])
        return _chunk(path, array, slot % size, size) if array.per_sample else _column(path, array, size)[slot % size]

    def label(self, name: str) -> Array:
        """Return a label of all slots."""
        array = self.arrays[name]
        size = self.manifest.spec.samples_per_shard
        shards = -(-self.manifest.sample_count // size)
        paths = [self._store.path(self._digests[array.shard_path(shard)]) for shard in range(shards)]
        return np.concatenate([_column(path, array, size) for path in paths])[: self.manifest.sample_count]

    def named(self, array: ArrayLayout, value: Array) -> object:
        """Return a label as people read it: the name of a code, a number, several numbers."""
        if array.categories:
            code = int(value)
            return array.categories[code] if 0 <= code < len(array.categories) else "none"
        return value.item() if value.ndim == 0 else ", ".join(f"{item:.4g}" for item in value.ravel())


def _chunk(path: Path, array: ArrayLayout, position: int, slots: int) -> Array:
    """Return the value of the sample at `position` of a shard; raise KeyError where it was rejected."""
    with path.open("rb") as file:
        file.seek(-shard_index_size(slots), 2)
        offset, length = (int(value) for value in decode_shard_index(file.read(), slots)[position])
        if offset == MISSING:
            raise KeyError(array.name)
        file.seek(offset)
        chunk = file.read(length)
    out = np.empty(array.shape, dtype=array.dtype)
    decode_sample(array, chunk, out)
    return out


@lru_cache(maxsize=256)
def _column(path: Path, array: ArrayLayout, slots: int) -> Array:
    """Return the values of a whole shard group; artifacts never change, so it is read once."""
    out = np.empty((slots, *array.shape), dtype=array.dtype)
    decode_chunk(path.read_bytes(), out)
    return out
