"""What a batch of each kind holds. A kind is one module here, of the name of the kind; nothing lists them."""

import os
from importlib import import_module
from typing import Any

from stickslip_schemas.kinds import kind_named

from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.samples import SampleDataset
from stickslip_training.data.version import Split

__all__ = ["dataset_class", "open_samples"]


def dataset_class(kind: str) -> type[SampleDataset]:
    """Return the torch dataset of a kind; raise UnknownKindError where the contract does not have the kind."""
    kind_named(kind)
    made: type[SampleDataset] = import_module(f"{__name__}.{kind}").DATASET
    return made


def open_samples(
    source: str | os.PathLike[str] | DatasetReader, split: Split | None = None, **options: Any
) -> SampleDataset:
    """Return the torch dataset of the kind that `source` is; `options` are those of its class."""
    reader = source if isinstance(source, DatasetReader) else DatasetReader(source)
    return dataset_class(reader.kind)(reader, split, **options)
