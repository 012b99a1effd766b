"""Read samples of a dataset version, from a directory, a bucket or over HTTP, into NumPy arrays.

There are no threads and nothing asynchronous, so a reader may be used before and after a fork, and it can be pickled.
Missing data raises; it is never replaced by zeros.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.format.codecs import empty_in_order, in_order_of_chunks

from stickslip_training.arrays import Array
from stickslip_training.data.errors import MissingFileError, RejectedSampleError
from stickslip_training.data.version import Version

Slots = Sequence[int] | npt.NDArray[np.integer[Any]]


class DatasetReader(Version):
    """One version of a dataset, open for reading. Samples are named by their slot, 0 to `len(reader)` - 1."""

    def read(self, name: str, slots: Slots) -> Array:
        """Return array `name` of the samples in `slots`, (len(slots), *sample shape)."""
        array = self.array(name)
        out = np.empty((len(slots), *array.shape), dtype=array.dtype)
        self.read_into(name, slots, out)
        return out

    def read_into(self, name: str, slots: Slots, out: Array) -> None:
        """Read array `name` of the samples in `slots` into `out`, C-ordered, (len(slots), *sample shape).

        `out` of clips may also have the order in memory that their chunks have, which is quicker: see `empty`.

        Raises:
            ValueError: There is no such array, or `out` has another shape, type or order.
            IndexError: A slot is beyond the end.
            RejectedSampleError: A sample was rejected.
            MissingFileError: A sample is not in the part of the version that the source holds.
            CorruptDataError: A chunk is damaged.
        """
        array = self.array(name)
        shape = (len(slots), *array.shape)
        ordered = out.flags.c_contiguous or (out.ndim == len(shape) and in_order_of_chunks(array, out))
        if out.shape != shape or out.dtype != np.dtype(array.dtype) or not ordered:
            raise ValueError(
                f"out must be C-ordered {array.dtype} of shape {shape} for {name}, and is {out.dtype} of {out.shape}"
            )
        for place, slot in enumerate(map(int, slots)):
            self._check_slot(slot)
            self.index.read_sample(array, slot, out[place, ...])

    def empty(self, name: str, count: int) -> Array:
        """Return an array for `count` samples, with its axes in memory as chunks have them: C-ordered but for clips."""
        return empty_in_order(self.array(name), count)

    def _check_slot(self, slot: int) -> None:
        if not 0 <= slot < len(self):
            raise IndexError(f"slot must be from 0 to {len(self) - 1}, and is {slot}")
        if not self.valid[slot]:
            reasons = [item for item in self.index.section(slot).rejections if item.slot == slot]
            raise RejectedSampleError(f"sample {slot} was rejected: {reasons[0].reason}, {reasons[0].message}")
        if not self.chosen[slot]:
            raise MissingFileError(
                f"sample {slot} is not in the part of the dataset that {self.source} holds: "
                f"{self.selection.model_dump_json()}"
            )
