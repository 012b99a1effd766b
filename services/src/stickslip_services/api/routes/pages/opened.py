"""The version of a dataset that a page shows: its rows, its arrays, and the jobs that made it."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

from fastapi import Depends
from stickslip_schemas.documents.responses import Dataset, DatasetVersion
from stickslip_schemas.store import Store

from stickslip_services.api.routes.common import ContextDep, Version
from stickslip_services.catalog.versions import find_dataset, find_version, read_contents
from stickslip_services.errors import NotFoundError
from stickslip_services.pages.pictures import shown_part
from stickslip_services.pages.samples import Array, SampleData
from stickslip_services.queue.jobs import jobs_of_version

PICTURE_SECONDS = 24 * 3600
"""Time for which a browser keeps a picture [s]."""


@dataclass(frozen=True, slots=True)
class Opened:
    """A version that a page shows, its arrays, and the jobs that made it (id, name)."""

    dataset: Dataset
    version: DatasetVersion
    data: SampleData
    jobs: list[tuple[str, str]]


def open_version(dataset: str, version: Version, context: ContextDep) -> Opened:
    """Return a version of a dataset; raise NotFoundError."""
    with context.database.read() as connection:
        visible_dataset = find_dataset(connection, dataset)
        visible_version = find_version(connection, dataset, version)
        makers = jobs_of_version(connection, dataset, version)
    # The manifest never changes, so what it lists is read once for all pages of the version.
    data = _sample_data(context.store, visible_version.manifest)
    return Opened(visible_dataset, visible_version, data, makers)


@lru_cache(maxsize=8)
def _sample_data(store: Store, manifest: str) -> SampleData:
    return SampleData(store, read_contents(store, manifest))


OpenedDep = Annotated[Opened, Depends(open_version)]


def value_of(data: SampleData, array: str, slot: int) -> Array:
    """Return the value of an array for a sample; raise NotFoundError."""
    if array not in data.arrays or slot >= data.manifest.sample_count:
        raise NotFoundError(f"the dataset has no {array[:50]!r} of sample {slot}")
    try:
        size = data.picture_size(slot)
        return shown_part(data.arrays[array], data.read(array, slot), size)
    except KeyError as error:
        raise NotFoundError(f"sample {slot} has no {array[:50]!r}") from error
