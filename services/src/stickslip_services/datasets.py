"""Datasets and their versions. A version exists when its manifest's digest is in the database, and not before."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Row, insert, select, update
from stickslip_schemas.keys import Sha256
from stickslip_schemas.manifest import MANIFEST_NAME, Manifest
from stickslip_schemas.responses import Dataset, DatasetRef, DatasetVersion, Page
from stickslip_schemas.samples import dataset_id
from stickslip_schemas.states import JobState
from stickslip_schemas.store import CorruptArtifactError, Store
from stickslip_schemas.tasks import FileEntry

from stickslip_services import events
from stickslip_services.clock import as_datetime
from stickslip_services.errors import MissingArtifactError, NotFoundError
from stickslip_services.ledger import LIVE, Ending, Ledger
from stickslip_services.paging import PageRequest, make_page
from stickslip_services.tables import dataset_versions, datasets, jobs


@dataclass(frozen=True, slots=True)
class CommittedVersion:
    """What the coordinator keeps of a manifest."""

    dataset: str
    version: int
    manifest: Sha256
    kind: str
    spec_digest: Sha256
    sample_count: int
    valid_count: int
    bytes: int


def read_version(store: Store, digest: Sha256, size: int) -> CommittedVersion:
    """Read a manifest that a worker says it has published; raise ValueError or OSError where it is not one.

    A version whose files are not all there must not come to be, so they are looked for, too.
    """
    manifest = Manifest.model_validate_json(store.read(digest))
    if dataset_id(manifest.spec) != manifest.dataset or manifest.spec.content_digest != manifest.spec_digest:
        raise ValueError(f"the manifest's dataset is {manifest.dataset}, and its spec is that of another")
    for file in manifest.files:
        if store.path(file.sha256).stat().st_size != file.size:
            raise CorruptArtifactError(f"{file.path} has another size than the manifest says")
    return CommittedVersion(
        dataset=manifest.dataset,
        version=manifest.version,
        manifest=digest,
        kind=manifest.spec.kind,
        spec_digest=manifest.spec_digest,
        sample_count=manifest.sample_count,
        valid_count=manifest.valid_count,
        bytes=size,
    )


def find_reserved(connection: Connection, publish_task: int) -> tuple[str, int] | None:
    """Return the dataset and the number of the version that a publish task is to make."""
    query = select(dataset_versions.c.dataset, dataset_versions.c.version)
    row = connection.execute(query.where(dataset_versions.c.publish_task == publish_task)).one_or_none()
    return None if row is None else (row.dataset, row.version)


def commit_version(book: Ledger, publish_task: int, version: CommittedVersion) -> None:
    """Let a version exist, and the jobs that asked for it succeed."""
    connection = book.connection
    holders = [holder.job for holder in book.holders([publish_task]).get(publish_task, ())]
    waiting = connection.execute(
        select(jobs.c.seq, jobs.c.name).where(jobs.c.seq.in_(holders), jobs.c.state.in_(LIVE)).order_by(jobs.c.seq)
    ).all()
    if connection.scalar(select(datasets.c.seq).where(datasets.c.id == version.dataset)) is None:
        connection.execute(
            insert(datasets).values(
                id=version.dataset,
                name=next((row.name for row in waiting if row.name is not None), None),
                kind=version.kind,
                spec_digest=version.spec_digest,
            )
        )
    connection.execute(
        update(dataset_versions)
        .where(dataset_versions.c.publish_task == publish_task)
        .values(
            manifest=version.manifest,
            created_at=book.now,
            sample_count=version.sample_count,
            valid_count=version.valid_count,
            bytes=version.bytes,
        )
    )
    for row in waiting:
        book.end_job(row.seq, give_dataset(connection, row.seq, publish_task, book.now))


def give_dataset(connection: Connection, job: int, publish_task: int, now: float) -> Ending:
    """Write down which version a job has made, or found, and return how the job ends."""
    versions = dataset_versions.c
    row = connection.execute(select(dataset_versions).where(versions.publish_task == publish_task)).one()
    rejected = row.sample_count - row.valid_count
    connection.execute(
        update(jobs)
        .where(jobs.c.seq == job)
        .values(dataset=row.dataset, version=row.version, manifest=row.manifest, rejected_count=rejected)
    )
    reference = DatasetRef(dataset=row.dataset, version=row.version, manifest=row.manifest)
    events.append_published(connection, job, reference, now)
    if rejected == 0:
        return Ending(JobState.succeeded, None, "")
    message = f"{rejected} of {row.sample_count} samples were rejected; the dataset lists them with their reasons"
    return Ending(JobState.succeeded_with_rejects, None, message)


def list_datasets(connection: Connection, page: PageRequest) -> Page[Dataset]:
    """Return a page of datasets, newest first."""
    query = select(datasets).order_by(datasets.c.seq.desc()).limit(page.size + 1)
    if page.after is not None:
        query = query.where(datasets.c.seq < page.after)
    rows = connection.execute(query).all()
    return make_page(rows, page, position=lambda row: int(row.seq), item=lambda row: _shown_dataset(connection, row))


def find_dataset(connection: Connection, dataset: str) -> Dataset:
    """Return a dataset with its committed versions; raise NotFoundError."""
    row = connection.execute(select(datasets).where(datasets.c.id == dataset)).one_or_none()
    if row is None:
        raise NotFoundError(f"there is no dataset {dataset[:100]!r}")
    return _shown_dataset(connection, row)


def find_version(connection: Connection, dataset: str, version: int) -> DatasetVersion:
    """Return a committed version; raise NotFoundError."""
    for known in find_dataset(connection, dataset).versions:
        if known.version == version:
            return known
    raise NotFoundError(f"dataset {dataset} has no version {version}")


def find_file(store: Store, manifest: Sha256, dataset: str, version: int, path: str) -> FileEntry:
    """Return the file at `path` of a version; raise NotFoundError where its manifest names none."""
    if path == MANIFEST_NAME:
        return FileEntry(path=path, sha256=manifest, size=_size(store, manifest))
    digest_and_size = _files(store.path(manifest)).get(path)
    if digest_and_size is None:
        raise NotFoundError(f"{dataset}, version {version}, has no file {path[:200]!r}")
    digest, size = digest_and_size
    if _size(store, digest) != size:
        raise MissingArtifactError(f"file {path} of {dataset}, version {version}, is damaged in the store")
    return FileEntry(path=path, sha256=digest, size=size)


@lru_cache(maxsize=16)
def _files(manifest: Path) -> Mapping[str, tuple[Sha256, int]]:
    """Return digest and size by path; a manifest never changes, so it is read once."""
    try:
        document = json.loads(manifest.read_bytes())
    except OSError as error:
        raise MissingArtifactError(f"the manifest {manifest.name} is not in the store") from error
    return {file["path"]: (file["sha256"], file["size"]) for file in document["files"]}


def _size(store: Store, digest: Sha256) -> int:
    try:
        return store.path(digest).stat().st_size
    except OSError as error:
        raise MissingArtifactError(f"artifact {digest} is not in the store") from error


def _shown_dataset(connection: Connection, row: Row[Any, Any, Any, Any, Any]) -> Dataset:
    versions = connection.execute(
        select(dataset_versions)
        .where(dataset_versions.c.dataset == row.id, dataset_versions.c.manifest.is_not(None))
        .order_by(dataset_versions.c.version)
    )
    return Dataset(
        id=row.id,
        name=row.name,
        kind=row.kind,
        spec_digest=row.spec_digest,
        versions=tuple(
            DatasetVersion(
                version=version.version,
                manifest=version.manifest,
                created_at=as_datetime(version.created_at),
                sample_count=version.sample_count,
                valid_count=version.valid_count,
                bytes=version.bytes,
            )
            for version in versions
        ),
    )
