"""Artifacts that nothing refers to: results of removed datasets, of lost workers and of calls that were made twice."""

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass

from sqlalchemy import select
from stickslip_schemas.base.keys import Sha256, is_sha256, sha256
from stickslip_schemas.format.manifest import Contents, Manifest, seal_text
from stickslip_schemas.store import Store

from stickslip_services.database.database import Database
from stickslip_services.database.tables import certificates, dataset_versions, jobs, previews, tasks

_DIGEST = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class Unused:
    """A file of the store that may go."""

    name: str
    """See `Store.delete`."""
    bytes: int


def unused(database: Database, store: Store, *, older_than: float) -> Iterator[Unused]:
    """Yield the artifacts and leftovers that nothing refers to and nobody has written for `older_than` seconds.

    Whatever a task, a job, a version or a certificate in the database names is kept. So is what the store knows to be
    shown by a version, whether the database knows that version or not. Raises CorruptArtifactError, OSError or
    ValueError where the manifest of a version cannot be read: then nobody can tell what it needs.
    """
    needed = _needed(database, store)
    latest = time.time() - older_than
    for file in store.stored():
        is_needed = is_sha256(file.name) and bytes.fromhex(file.name) in needed
        if not is_needed and not file.is_shown and file.modified_at < latest:
            yield Unused(file.name, file.bytes)


def _needed(database: Database, store: Store) -> set[bytes]:
    """Return the digests of all artifacts that the database refers to."""
    needed: set[bytes] = set()

    def add(*digests: Sha256 | None) -> None:
        needed.update(bytes.fromhex(digest) for digest in digests if digest)

    with database.read() as connection:
        for texts in connection.execute(select(tasks.c.output, tasks.c.payload)):
            for text in texts:
                add(*_DIGEST.findall(text or ""))
        add(*connection.scalars(select(previews.c.digest)))
        for manifest, spec in connection.execute(select(jobs.c.manifest, jobs.c.spec)):
            add(manifest, *_DIGEST.findall(spec))  # a spec names textures, also before its tasks are planned
        for certificate in connection.execute(select(certificates.c.artifact, certificates.c.page)):
            add(*certificate)
        columns = dataset_versions.c
        versions = connection.execute(
            select(columns.manifest, columns.group_digest).where(columns.manifest.is_not(None))
        )
        for manifest, group in versions.all():
            contents = Contents(
                Manifest.model_validate_json(store.read(manifest)), lambda file: store.read(file.sha256)
            )
            add(manifest, group, *(file.sha256 for file in contents.files()))
            if group is not None:
                add(sha256(seal_text(manifest, group)))
    return needed
