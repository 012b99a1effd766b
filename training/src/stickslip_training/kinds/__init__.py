"""The kinds of datasets, each in a file of its name: which arrays and labels a batch of it holds."""

import os
from typing import Any

from stickslip_training.data.reader import DatasetReader, Split
from stickslip_training.data.samples import SampleDataset
from stickslip_training.kinds.cloth_drag import ClipDataset
from stickslip_training.kinds.rod_hang import RodDataset

__all__ = ["KINDS", "ClipDataset", "RodDataset", "open_samples"]

KINDS: dict[str, type[SampleDataset]] = {dataset.kind: dataset for dataset in (RodDataset, ClipDataset)}
"""A new kind is registered here."""


def open_samples(
    source: str | os.PathLike[str] | DatasetReader, split: Split | None = None, **options: Any
) -> SampleDataset:
    """Return the torch dataset of the kind that `source` is; `options` are those of its class."""
    reader = source if isinstance(source, DatasetReader) else DatasetReader(source)
    if reader.kind not in KINDS:
        raise ValueError(f"kind of the dataset must be one of {', '.join(KINDS)}, and is {reader.kind!r}")
    return KINDS[reader.kind](reader, split, **options)
