"""Datasets, their versions and files.

A version exists as soon as the digest of its manifest is in the database.
"""

import time
from collections.abc import Mapping
from functools import lru_cache, partial
from math import inf
from pathlib import Path
from typing import Any

from sqlalchemy import ColumnElement, Connection, Row, exists, func, insert, or_, select, update
from stickslip_schemas.base import Sha256, sha256
from stickslip_schemas.documents.responses import Dataset, DatasetVersion, Page
from stickslip_schemas.documents.tasks import (
    PackOutput,
    PublishOutput,
    RenderOutput,
    SimulateOutput,
)
from stickslip_schemas.format.manifest import (
    GROUP_NAME,
    MANIFEST_NAME,
    SEAL_NAME,
    SIGNATURE_NAME,
    Contents,
    FileEntry,
    Manifest,
    check_seal,
    seal_text,
)
from stickslip_schemas.store import CorruptArtifactError, Store, in_parallel, is_unavailable

from stickslip_services.access.principals import (
    current_principal,
    is_visible_project,
    is_visible_version,
)
from stickslip_services.client.signing import is_signature, sign
from stickslip_services.database.database import PageRequest, document_of, read_page
from stickslip_services.database.tables import dataset_versions, datasets, jobs
from stickslip_services.errors import NotFoundError

HEADS_AT_ONCE = 128
"""Number of parallel requests to the store; a worker waits for the answer."""


def stored_contents(store: Store, manifest: Sha256) -> Contents:
    """Return the contents that a manifest in the store lists.

    Raises OSError or ValueError. Sections are read on demand.
    """
    # The store compares an artifact with its digest, so a damaged manifest raises here.
    document = Manifest.model_validate_json(store.read(manifest))
    return Contents(document, lambda file: store.read(file.sha256))


def sealed_digests(manifest: Sha256, group: Sha256) -> dict[str, Sha256]:
    """Return the digests of the files of a version that its manifest does not list, by path."""
    return {
        MANIFEST_NAME: manifest,
        GROUP_NAME: group,
        SEAL_NAME: sha256(seal_text(manifest, group)),
    }


def read_version(store: Store, output: PublishOutput) -> Manifest:
    """Read a manifest that a worker has published, and check that all its files are in the store.

    Raises ValueError or OSError.
    """
    check_seal(*map(store.read, sealed_digests(output.manifest, output.group).values()))
    contents = stored_contents(store, output.manifest)
    manifest = contents.manifest
    if (
        manifest.spec.dataset_id != manifest.dataset
        or manifest.spec.content_digest != manifest.spec_digest
    ):
        raise ValueError(
            f"the manifest's dataset is {manifest.dataset}, and its spec is that of another"
        )
    # Sizes are looked up and not contents: the worker has just written them, and the scrub reads
    # them later.
    files = list(contents.files())
    sizes = in_parallel(lambda file: store.size(file.sha256), files, at_once=HEADS_AT_ONCE)
    for file, size in zip(files, sizes, strict=True):
        if size != file.size:
            raise CorruptArtifactError(f"{file.path} has another size than the manifest says")
    return manifest


def sign_version(store: Store, dataset: str, version: int, seal: bytes, key: Path) -> None:
    """Sign a version; raise ClientError if the key cannot sign."""
    store.show(store.publish(sign(seal, key)), dataset, version, SIGNATURE_NAME)


def mend_signature(store: Store, dataset: str, version: int, seal: bytes, key: Path) -> bool:
    """Sign a version whose signature is missing or broken, and return whether it was signed.

    Raises ClientError if the key cannot sign, and OSError if the store is out of reach.
    """
    try:
        if is_signature(store.read_shown(dataset, version, SIGNATURE_NAME), seal):
            return False
    except FileNotFoundError:
        pass
    sign_version(store, dataset, version, seal, key)
    return True


def check_output(store: Store, output: SimulateOutput | RenderOutput | PackOutput) -> None:
    """Raise CorruptArtifactError if an artifact of a worker's output is not in the store."""
    # An artifact must be at least as long as its parts that the output names.
    min_sizes: dict[Sha256, int] = {}
    if isinstance(output, SimulateOutput):
        min_sizes[output.record.digest] = 1
    elif isinstance(output, RenderOutput):
        for chunk in output.chunks.values():
            min_sizes[chunk.digest] = chunk.offset + chunk.length
        if output.preview is not None:
            min_sizes[output.preview] = 1
    else:
        min_sizes |= {file.sha256: file.size for file in output.files}
        min_sizes[output.labels] = 1
    for digest, size in min_sizes.items():
        if not store.exists(digest, size=size):
            raise CorruptArtifactError(
                f"artifact {digest} must be in the store with at least {size} bytes"
            )


def find_reserved(connection: Connection, publish_task: int) -> tuple[str, int] | None:
    """Return the dataset and the version number reserved for a publish task."""
    query = select(dataset_versions.c.dataset, dataset_versions.c.version)
    row = connection.execute(
        query.where(dataset_versions.c.publish_task == publish_task)
    ).one_or_none()
    return None if row is None else (row.dataset, row.version)


def version_number(connection: Connection, dataset: str, publish_task: int) -> int:
    """Return the version number of a publish task: its own, or the next free one of its dataset."""
    reserved = find_reserved(connection, publish_task)
    if reserved is not None:
        return reserved[1]
    latest = select(func.coalesce(func.max(dataset_versions.c.version), 0))
    return int(connection.scalar(latest.where(dataset_versions.c.dataset == dataset)) or 0) + 1


def reserve_number(connection: Connection, dataset: str, version: int, publish_task: int) -> None:
    """Reserve a version number for a publish task."""
    connection.execute(
        insert(dataset_versions).values(dataset=dataset, version=version, publish_task=publish_task)
    )


def commit_version(
    connection: Connection,
    publish_task: int,
    manifest: Manifest,
    output: PublishOutput,
    *,
    name: str | None,
    now: float,
) -> None:
    """Commit a version; with its first version a dataset gets its `name`."""
    # The first version makes the dataset.
    if connection.scalar(select(datasets.c.seq).where(datasets.c.id == manifest.dataset)) is None:
        row = {
            "id": manifest.dataset,
            "name": name,
            "kind": manifest.spec.kind,
            "spec_digest": manifest.spec_digest,
        }
        connection.execute(insert(datasets).values(row))
    connection.execute(
        update(dataset_versions)
        .where(dataset_versions.c.publish_task == publish_task)
        .values(
            manifest=output.manifest,
            group_digest=output.group,
            created_at=func.coalesce(dataset_versions.c.created_at, now),
            sample_count=manifest.sample_count,
            valid_count=manifest.valid_count,
            bytes=output.bytes,
            scrubbed_at=now,
            damaged=0,
        )
    )


def find_committed(connection: Connection, publish_task: int) -> Row[Any]:
    """Return the row of the version that a publish task has made."""
    return connection.execute(
        select(dataset_versions).where(dataset_versions.c.publish_task == publish_task)
    ).one()


def damaged_files(
    store: Store, manifest: Sha256, group: Sha256, *, rate: float = inf
) -> Mapping[str, Sha256] | None:
    """Return path and digest of the damaged files of a version.

    Both the artifact in the store and the file in the directory of the version are read, at `rate`
    [bytes/s]. None if the manifest, the root's metadata or the seal is damaged, so that the others
    are unknown. Raises OSError if the store is out of reach.
    """
    sealed = sealed_digests(manifest, group)
    try:
        contents = stored_contents(store, manifest)
        check_seal(*map(store.read, sealed.values()))
        listed = list(contents.files())
    except (OSError, ValueError) as error:
        if isinstance(error, OSError) and is_unavailable(error):
            raise
        return None
    files = sealed | {file.path: file.sha256 for file in listed}
    sizes = {file.path: file.size for file in listed}
    dataset = contents.manifest.dataset
    version = contents.manifest.version

    def is_whole(entry: tuple[str, Sha256]) -> bool:
        path, digest = entry
        # Reading as fast as the disk can would slow the tasks down.
        time.sleep(sizes.get(path, 0) / rate)
        return store.shows(digest, dataset, version, path) and store.holds(digest)

    # Threads of a pool would read to the end before the process may end.
    whole = in_parallel(is_whole, files.items()) if rate == inf else map(is_whole, files.items())
    return {
        path: digest
        for (path, digest), is_good in zip(files.items(), whole, strict=True)
        if not is_good
    }


def list_datasets(
    connection: Connection, page: PageRequest, search: str = "", *, newest_first: bool = True
) -> Page[Dataset]:
    """Return a page of datasets; `search` keeps those that have it in the id, kind or name."""
    to_dataset = partial(_dataset_of, connection)
    query = select(datasets).where(_is_visible_dataset())
    if search:
        query = query.where(_matches(search))
    return read_page(
        connection,
        query,
        page,
        datasets.c.seq,
        lambda rows: map(to_dataset, rows),
        newest_first=newest_first,
    )


def _matches(search: str) -> ColumnElement[bool]:
    """Return the condition that a dataset has a text in the id, kind, or a name that is shown."""
    columns = [datasets.c.id, datasets.c.kind]
    # The first name may be that of another project, which a search must not tell.
    if current_principal().sees_all:
        columns.append(datasets.c.name)
    is_named = exists().where(
        jobs.c.dataset == datasets.c.id,
        is_visible_project(jobs.c.project),
        jobs.c.name.icontains(search, autoescape=True),
    )
    return or_(is_named, *(column.icontains(search, autoescape=True) for column in columns))


def find_dataset(connection: Connection, dataset: str) -> Dataset:
    """Return a dataset with its committed versions; raise NotFoundError."""
    row = connection.execute(
        select(datasets).where(datasets.c.id == dataset, _is_visible_dataset())
    ).one_or_none()
    if row is None:
        raise NotFoundError(f"there is no dataset {dataset[:100]!r}")
    return _dataset_of(connection, row)


def find_version(connection: Connection, dataset: str, version: int) -> DatasetVersion:
    """Return a committed version; raise NotFoundError."""
    for known in find_dataset(connection, dataset).versions:
        if known.version == version:
            return known
    raise NotFoundError(f"dataset {dataset} has no version {version}")


def find_file(store: Store, version: DatasetVersion, path: str) -> FileEntry:
    """Return the file at `path` of a version.

    Raises NotFoundError if the version has no such file. Raises OSError or BrokenSectionError if
    the store has lost or damaged the file, or the section that lists it.
    """
    # The manifest cannot list itself, nor the seal that holds its digest.
    digests = sealed_digests(version.manifest, version.group)
    if path in digests:
        return FileEntry(path=path, sha256=digests[path], size=store.size(digests[path]))
    file = read_contents(store, version.manifest).file(path)
    if file is None:
        raise NotFoundError(f"version {version.version} has no file {path[:200]!r}")
    if store.size(file.sha256) != file.size:
        raise CorruptArtifactError(
            f"file {path} of version {version.version} is damaged in the store"
        )
    return file


read_contents = lru_cache(maxsize=16)(stored_contents)
"""Returns the contents that a manifest lists.

They never change. A section is read with the first request for one of its files.
"""


def _is_visible_dataset() -> ColumnElement[bool]:
    return exists().where(dataset_versions.c.dataset == datasets.c.id, is_visible_version())


def _dataset_of(connection: Connection, row: Row[Any, Any, Any, Any, Any]) -> Dataset:
    """Return the dataset of a row as the principal sees it: its versions, and its own name."""
    columns = dataset_versions.c
    versions = connection.execute(
        select(dataset_versions)
        .where(columns.dataset == row.id, columns.manifest.is_not(None), is_visible_version())
        .order_by(columns.version)
    )
    documents = tuple(
        document_of(DatasetVersion, version, group=version.group_digest) for version in versions
    )
    name = _visible_name(connection, row.id, row.name)
    return document_of(Dataset, row, name=name, versions=documents)


def _visible_name(connection: Connection, dataset: str, first_name: str | None) -> str | None:
    """Return the name of a dataset for the principal.

    Projects share a dataset that they have specified alike, but not the names that they gave it. So
    a project sees the name in the first of its own jobs that has one. The dataset got `first_name`
    with its first version. It is for principals who see all projects, and for versions without a
    job.
    """
    if current_principal().sees_all:
        return first_name
    columns = dataset_versions.c
    makes_it = (jobs.c.publish_task == columns.publish_task) & (columns.dataset == dataset)
    if connection.scalar(select(~exists().where(makes_it))):
        return first_name
    query = (
        select(jobs.c.name)
        .join(dataset_versions, makes_it)
        .where(jobs.c.name.is_not(None), is_visible_project(jobs.c.project))
        .order_by(jobs.c.seq)
        .limit(1)
    )
    name: str | None = connection.scalar(query)
    return name
