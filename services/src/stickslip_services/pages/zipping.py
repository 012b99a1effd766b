"""Chosen samples as a zip file, which is written while it is sent."""

import csv
from collections.abc import Iterator, Sequence
from io import BytesIO, StringIO
from zipfile import ZIP_STORED, ZipFile, ZipInfo

import numpy as np

from stickslip_services.pages.samples import SampleData

MAX_ZIPPED = 200
"""Most samples of a zip file. `stickslip pull` takes more, and continues where it broke off."""

_EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time of all entries, so that the same samples give the same file."""


class _Sink:
    """A file that keeps what is written until it is taken, and cannot seek."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def write(self, data: bytes) -> int:
        self._parts.append(bytes(data))
        return len(data)

    def flush(self) -> None:
        """Do nothing: all is kept."""

    def close(self) -> None:
        """Do nothing: there is nothing to close."""

    def take(self) -> bytes:
        data = b"".join(self._parts)
        self._parts.clear()
        return data


def zipped(data: SampleData, slots: Sequence[int]) -> Iterator[bytes]:
    """Yield the parts of a zip file with some samples; rejected ones are left out.

    It has `labels.csv`, a line for each sample, and each array of a sample as `ARRAY/SLOT.npy`. One
    array is in memory at a time.
    """
    valid = [slot for slot in slots if data.rejection(slot) is None]
    sink = _Sink()
    with ZipFile(sink, "w", ZIP_STORED) as file:
        file.writestr(_entry("labels.csv"), _labels(data, valid))
        yield sink.take()
        for slot in valid:
            for array in data.arrays.values():
                if not array.is_label:
                    content = BytesIO()
                    np.save(content, data.read(array.name, slot), allow_pickle=False)
                    file.writestr(_entry(f"{array.name}/{slot:07d}.npy"), content.getvalue())
                    yield sink.take()
    # The list of contents is written last.
    yield sink.take()


def _entry(name: str) -> ZipInfo:
    return ZipInfo(name, _EPOCH)


def _labels(data: SampleData, slots: Sequence[int]) -> str:
    """Return the labels of some samples as CSV; the numbers of a vector stand in one cell."""
    names = [array.name for array in data.arrays.values() if array.is_label]
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["slot", *names])
    for slot in slots:
        values = [data.named(data.arrays[name], data.read(name, slot)) for name in names]
        writer.writerow([slot, *values])
    return text.getvalue()
