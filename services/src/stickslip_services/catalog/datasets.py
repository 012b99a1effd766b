"""Datasets, their versions and their files, as the API shows them."""

from functools import lru_cache, partial
from typing import Any

from sqlalchemy import ColumnElement, Connection, Row, exists, select
from stickslip_schemas.documents.responses import Dataset, DatasetVersion, Page
from stickslip_schemas.format.manifest import FileEntry
from stickslip_schemas.store import CorruptArtifactError, Store

from stickslip_services.access.asker import own_version
from stickslip_services.catalog.versions import sealed_digests, stored_contents
from stickslip_services.database.paging import PageRequest, document_of, read_page
from stickslip_services.database.tables import dataset_versions, datasets
from stickslip_services.errors import NotFoundError


def list_datasets(connection: Connection, page: PageRequest) -> Page[Dataset]:
    """Return a page of datasets, newest first."""
    shown = partial(_shown_dataset, connection)
    return read_page(connection, select(datasets).where(_is_own()), page, datasets.c.seq, lambda rows: map(shown, rows))


def find_dataset(connection: Connection, dataset: str) -> Dataset:
    """Return a dataset with its committed versions; raise NotFoundError."""
    row = connection.execute(select(datasets).where(datasets.c.id == dataset, _is_own())).one_or_none()
    if row is None:
        raise NotFoundError(f"there is no dataset {dataset[:100]!r}")
    return _shown_dataset(connection, row)


def find_version(connection: Connection, dataset: str, version: int) -> DatasetVersion:
    """Return a committed version; raise NotFoundError."""
    for known in find_dataset(connection, dataset).versions:
        if known.version == version:
            return known
    raise NotFoundError(f"dataset {dataset} has no version {version}")


def find_file(store: Store, version: DatasetVersion, path: str) -> FileEntry:
    """Return the file at `path` of a version; raise NotFoundError where the version has none.

    Raises OSError or BrokenSectionError where the store has lost or damaged it, or what lists it.
    """
    digests = sealed_digests(version.manifest, version.group)
    if path in digests:
        return FileEntry(path=path, sha256=digests[path], size=store.size(digests[path]))
    file = read_contents(store, version.manifest).file(path)
    if file is None:
        raise NotFoundError(f"version {version.version} has no file {path[:200]!r}")
    if store.size(file.sha256) != file.size:
        raise CorruptArtifactError(f"file {path} of version {version.version} is damaged in the store")
    return file


read_contents = lru_cache(maxsize=16)(stored_contents)
"""Returns what a manifest lists. It never changes; a section is read with the first request for one of its files."""


def _is_own() -> ColumnElement[bool]:
    return exists().where(dataset_versions.c.dataset == datasets.c.id, own_version())


def _shown_dataset(connection: Connection, row: Row[Any, Any, Any, Any, Any]) -> Dataset:
    versions = connection.execute(
        select(dataset_versions)
        .where(dataset_versions.c.dataset == row.id, dataset_versions.c.manifest.is_not(None), own_version())
        .order_by(dataset_versions.c.version)
    )
    shown = (document_of(DatasetVersion, version, group=version.group_digest) for version in versions)
    return document_of(Dataset, row, versions=tuple(shown))
