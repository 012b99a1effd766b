"""Artifacts that hold several records: `.npz`, the first dimension of every array is the record."""

import io
from collections import OrderedDict
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from stickslip_schemas.store import Store

Array = npt.NDArray[np.generic]

KEPT_BYTES = 256 * 2**20


def encode_records(arrays: Mapping[str, Array]) -> bytes:
    """Return the file of `arrays`. The same arrays give the same bytes: numpy dates every member 1980-01-01."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


class Records:
    """Reads records; an artifact that several slots share is read and checked once, while it is among the last ones."""

    def __init__(self, store: Store, *, kept_bytes: int = KEPT_BYTES) -> None:
        self._store = store
        self._artifacts: OrderedDict[str, dict[str, Array]] = OrderedDict()
        self._kept_bytes = kept_bytes
        self._bytes = 0

    def __call__(self, digest: str) -> dict[str, Array]:
        if digest in self._artifacts:
            self._artifacts.move_to_end(digest)
            return self._artifacts[digest]
        with np.load(io.BytesIO(self._store.read(digest)), allow_pickle=False) as arrays:
            artifact = self._artifacts[digest] = dict(arrays)
        self._bytes += _size(artifact)
        while self._bytes > self._kept_bytes and len(self._artifacts) > 1:
            self._bytes -= _size(self._artifacts.popitem(last=False)[1])
        return artifact


def _size(artifact: Mapping[str, Array]) -> int:
    return sum(values.nbytes for values in artifact.values())
