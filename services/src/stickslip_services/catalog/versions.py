"""Versions as they are made. A version exists when its manifest's digest is in the database, and not before."""

from dataclasses import dataclass

from sqlalchemy import Connection, insert, select, update
from stickslip_schemas.keys import Sha256
from stickslip_schemas.manifest import Manifest
from stickslip_schemas.responses import DatasetRef
from stickslip_schemas.samples import dataset_id
from stickslip_schemas.store import CorruptArtifactError, Store

from stickslip_services.database.tables import dataset_versions, datasets


@dataclass(frozen=True, slots=True)
class ManifestSummary:
    """What the coordinator keeps of a manifest."""

    dataset: str
    version: int
    manifest: Sha256
    kind: str
    spec_digest: Sha256
    sample_count: int
    valid_count: int
    bytes: int


@dataclass(frozen=True, slots=True)
class CommittedVersion:
    """A version that exists."""

    reference: DatasetRef
    sample_count: int
    rejected_count: int


def read_version(store: Store, digest: Sha256, size: int) -> ManifestSummary:
    """Read a manifest that a worker says it has published; raise ValueError or OSError where it is not one.

    A version whose files are not all there must not come to be, so they are looked for, too.
    """
    manifest = Manifest.model_validate_json(store.read(digest))
    if dataset_id(manifest.spec) != manifest.dataset or manifest.spec.content_digest != manifest.spec_digest:
        raise ValueError(f"the manifest's dataset is {manifest.dataset}, and its spec is that of another")
    for file in manifest.files:
        if store.path(file.sha256).stat().st_size != file.size:
            raise CorruptArtifactError(f"{file.path} has another size than the manifest says")
    return ManifestSummary(
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


def commit_version(
    connection: Connection, publish_task: int, summary: ManifestSummary, *, name: str | None, now: float
) -> None:
    """Let a version exist; its dataset is called `name` if this is its first version."""
    if connection.scalar(select(datasets.c.seq).where(datasets.c.id == summary.dataset)) is None:
        connection.execute(
            insert(datasets).values(id=summary.dataset, name=name, kind=summary.kind, spec_digest=summary.spec_digest)
        )
    connection.execute(
        update(dataset_versions)
        .where(dataset_versions.c.publish_task == publish_task)
        .values(
            manifest=summary.manifest,
            created_at=now,
            sample_count=summary.sample_count,
            valid_count=summary.valid_count,
            bytes=summary.bytes,
        )
    )


def find_committed(connection: Connection, publish_task: int) -> CommittedVersion:
    """Return the version that a publish task has made."""
    row = connection.execute(select(dataset_versions).where(dataset_versions.c.publish_task == publish_task)).one()
    reference = DatasetRef(dataset=row.dataset, version=row.version, manifest=row.manifest)
    return CommittedVersion(reference, row.sample_count, row.sample_count - row.valid_count)
