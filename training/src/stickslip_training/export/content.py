"""What an export holds: the samples of a part of a version, in the order of their slots, one at a time.

Rejected samples are left out in every format, so no fill value is ever taken for a sample. The array `slot` says which
slot of the version each sample has. An export is there whole or not at all, and overwrites nothing.
"""

import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base import sha256
from stickslip_schemas.format.selection import Selection
from stickslip_schemas.spec.arrays import SPLITS, ArrayLayout, describe
from stickslip_schemas.store import sync

from stickslip_training.arrays import Array
from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.sources import CorruptDataError

OnBytes = Callable[[int], None]
"""Hears how many decoded bytes have been written."""

SLOT = ArrayLayout("slot", "int64", (), (), "slot of the sample in the version")
MANIFEST_COPY = "source-manifest.json"
DESCRIPTION = "dataset.json"
FILE_BYTES = 256 * 2**20
"""Decoded samples that go into one file, where a format has many files [bytes]."""


@dataclass(frozen=True, slots=True)
class Part:
    """Slots of one split that go into one file."""

    split: str
    number: int
    count: int
    """How many files the split has."""
    slots: npt.NDArray[np.int64]


class Content:
    """What is exported of a version."""

    def __init__(self, reader: DatasetReader, selection: Selection) -> None:
        """Choose; raise ValueError where the selection makes no sense or leaves no sample."""
        self.reader = reader
        self.selection = selection
        everything = reader.arrays.values()
        chosen = reader.chosen & selection.choose_samples(everything, reader.label)
        self.slots = np.flatnonzero(chosen).astype(np.int64)
        if not len(self.slots):
            raise ValueError(f"no valid sample is in this part of the dataset: {selection.model_dump_json()}")
        # All samples of an export are valid.
        self.arrays = (SLOT, *(array for array in selection.choose_arrays(everything) if array.name != "valid"))

    @property
    def name(self) -> str:
        """The version, as `ds-...:v1`."""
        return f"{self.reader.manifest.dataset}:v{self.reader.manifest.version}"

    @property
    def title(self) -> str:
        """A name for people."""
        return self.reader.spec.name or self.reader.manifest.dataset

    @property
    def sample_bytes(self) -> int:
        """Decoded size of one sample [bytes]."""
        return sum(array.sample_bytes for array in self.arrays)

    @property
    def labels(self) -> tuple[ArrayLayout, ...]:
        return tuple(array for array in self.arrays if array.is_label)

    def read(self, name: str, slots: npt.NDArray[np.int64]) -> Array:
        """Return an array of samples, (len(slots), *sample shape)."""
        if name == SLOT.name:
            return slots
        if self.reader.arrays[name].is_label:
            return self.reader.label(name)[slots]
        return self.reader.read(name, slots)

    def parts(self) -> Iterator[Part]:
        """Yield what goes into each file, split by split."""
        size = max(1, FILE_BYTES // self.sample_bytes)
        splits = self.reader.label("split")[self.slots]
        for code, split in enumerate(SPLITS):
            slots = self.slots[splits == code]
            count = -(-len(slots) // size)
            for number in range(count):
                yield Part(split, number, count, slots[number * size : (number + 1) * size])

    def manifest(self) -> bytes:
        """Return the bytes of the version's manifest."""
        data = self.reader.source.read_manifest()
        if sha256(data) != self.reader.manifest_digest:
            raise CorruptDataError(f"the manifest of {self.reader.source} has changed since it was opened")
        return data

    def identity(self) -> dict[str, Any]:
        """Return which version, and which part of it, the export is of."""
        manifest = self.reader.manifest
        return {
            "dataset": manifest.dataset,
            "version": manifest.version,
            "kind": self.reader.kind,
            "manifest_sha256": self.reader.manifest_digest,
            "certificate": manifest.certificate,
            "selection": self.selection.model_dump(mode="json"),
            "sample_count": len(self.slots),
        }

    def description(self) -> bytes:
        """Return a JSON document that says what the export is of, and what each array of it is."""
        arrays = {
            array.name: {
                "dtype": array.dtype,
                "shape": list(array.shape),
                "dimensions": list(array.dimensions),
                **describe(array),
            }
            for array in self.arrays
        }
        return (json.dumps(self.identity() | {"arrays": arrays}, indent=2) + "\n").encode()


def to_directory(
    content: Content, target: Path, on_bytes: OnBytes, write: Callable[[Content, Path, OnBytes], None]
) -> None:
    """Let `write` fill a directory, and add the manifest and a description."""
    with made_whole(target) as scratch:
        scratch.mkdir()
        (scratch / MANIFEST_COPY).write_bytes(content.manifest())
        (scratch / DESCRIPTION).write_bytes(content.description())
        write(content, scratch, on_bytes)


@contextmanager
def made_whole(target: Path) -> Iterator[Path]:
    """Give a path beside `target` to write to, which becomes `target` at the end, or vanishes after an error.

    Raises FileExistsError, and overwrites nothing, where `target` exists.
    """
    _refuse_existing(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    scratch = target.with_name(f".{target.name}.{uuid.uuid4().hex}.tmp")
    try:
        yield scratch
        for path in [scratch, *scratch.rglob("*")]:
            sync(path)
        _refuse_existing(target)
        scratch.rename(target)
        sync(target.parent)
    finally:
        if scratch.is_dir():
            shutil.rmtree(scratch)
        else:
            scratch.unlink(missing_ok=True)


def _refuse_existing(target: Path) -> None:
    if os.path.lexists(target):
        raise FileExistsError(f"{target} exists, and an export overwrites nothing: name another place")
