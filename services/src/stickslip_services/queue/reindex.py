"""Rebuilding the index of datasets from the store after the database was lost.

A version is identified by its manifest, the metadata of its root, and the seal that binds both. For each intact version
the job that made it is inserted, so that the dataset is listed and can be pulled, and a spec that is submitted again
finds it. Results of single simulations and renders, and certificates, are not restored.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from sqlalchemy import select, update
from stickslip_schemas.base import Sha256, Stage, TaskState, sha256
from stickslip_schemas.documents.tasks import PublishOutput
from stickslip_schemas.format.manifest import GROUP_NAME, MANIFEST_NAME, SEAL_NAME, Contents, Manifest, check_seal
from stickslip_schemas.store import ShownVersion, Store, in_parallel

from stickslip_services.catalog.versions import (
    commit_version,
    find_committed,
    read_version,
    reserve_number,
    sealed_digests,
)
from stickslip_services.database.database import Database
from stickslip_services.database.tables import dataset_versions, jobs, tasks
from stickslip_services.queue.ledger import Task, ledger
from stickslip_services.queue.plan import Terms, pieces
from stickslip_services.queue.write_plan import begin_planning, insert_job, write_plan

PIECE = 10_000
"""Size of the pieces of a plan [samples]."""


@dataclass(frozen=True, slots=True)
class Found:
    """A version in the store."""

    name: str
    """Dataset and version, as in `ds-0123456789abcdef:v1`."""
    samples: int
    fault: str
    """Why it was left out; empty if it was not."""
    is_new: bool = True


def reindex(database: Database, store: Store) -> Iterator[Found]:
    """Insert the versions that only the store has, one transaction each; yield all versions of the store."""
    for shown in store.versions(MANIFEST_NAME):
        name = f"{shown.dataset}:v{shown.version}"
        try:
            manifest, output = _read(store, shown)
        except (OSError, ValueError) as error:
            yield Found(name, 0, str(error).splitlines()[0])
            continue
        is_new = _insert(database, store, manifest, output, shown.modified_at)
        yield Found(name, manifest.sample_count, "", is_new)


def _read(store: Store, shown: ShownVersion) -> tuple[Manifest, PublishOutput]:
    """Read a version; restore lost artifacts from the files of the version."""
    place = shown.dataset, shown.version
    content, group, seal = (store.read_shown(*place, name) for name in (MANIFEST_NAME, GROUP_NAME, SEAL_NAME))
    check_seal(content, group, seal)
    manifest = Manifest.model_validate_json(content)
    if (manifest.spec.dataset_id, manifest.version) != place:
        raise ValueError(f"the manifest is that of {manifest.spec.dataset_id}, v{manifest.version}")
    own = sealed_digests(sha256(content), sha256(group))
    listed = list(Contents(manifest, lambda file: store.read_shown(*place, file.path)).files())

    def put_back(shown: tuple[str, Sha256]) -> None:
        path, digest = shown
        if not store.exists(digest, size=1):
            store.publish(store.read_shown(*place, path))

    in_parallel(put_back, (own | {file.path: file.sha256 for file in listed}).items())
    size = sum(file.size for file in listed) + len(content) + len(group) + len(seal)
    output = PublishOutput(manifest=own[MANIFEST_NAME], group=own[GROUP_NAME], bytes=size)
    read_version(store, output)  # every file is there
    return manifest, output


def _insert(database: Database, store: Store, manifest: Manifest, output: PublishOutput, made_at: float) -> bool:
    """Insert a version as the result of an ended job; return False where it is known."""
    terms = Terms(manifest.builds, manifest.certificate)
    with database.write() as connection:
        known = select(dataset_versions).filter_by(dataset=manifest.dataset, version=manifest.version)
        if connection.execute(known).first() is not None:
            return False
        with ledger(connection, made_at) as book:
            job = insert_job(book, manifest.spec)
            begin_planning(book, job, terms)
            for piece in pieces(manifest.spec, terms, size=PIECE):
                write_plan(book, job, piece)
            task = connection.scalar(select(jobs.c.publish_task).where(jobs.c.seq == job))
            assert task is not None
            connection.execute(
                update(tasks)
                .where(tasks.c.seq == task)
                .values(state=TaskState.succeeded, output=output.model_dump_json(), finished_at=made_at)
            )
            book.moved([Task(task, Stage.publish, TaskState.pending)], TaskState.succeeded)
            reserve_number(connection, manifest.dataset, manifest.version, task)
            commit_version(connection, task, manifest, output, name=manifest.spec.name, now=made_at)
            for holder in book.jobs_of(task):
                book.publish(holder, find_committed(connection, task), "found again in the store")
    return True
