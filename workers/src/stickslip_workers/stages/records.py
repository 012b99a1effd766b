"""Artifacts that hold several records: `.npz`, the first dimension of every array is the record."""

import io
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from stickslip_schemas.store import Store

Array = npt.NDArray[np.generic]


def encode_records(arrays: Mapping[str, Array]) -> bytes:
    """Return the file of `arrays`. The same arrays give the same bytes: numpy dates every member 1980-01-01."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


class Records:
    """Reads records; an artifact that several slots share is read and checked once."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._artifacts: dict[str, dict[str, Array]] = {}

    def __call__(self, digest: str) -> dict[str, Array]:
        """Return the arrays of an artifact."""
        if digest not in self._artifacts:
            with np.load(io.BytesIO(self._store.read(digest)), allow_pickle=False) as arrays:
                self._artifacts[digest] = dict(arrays)
        return self._artifacts[digest]
