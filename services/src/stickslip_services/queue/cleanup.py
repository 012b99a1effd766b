"""Clean-up: removing versions of datasets, and finding artifacts that nothing refers to.

A version goes with the jobs that made it, and the tasks that no other job needs. Its files stay in the store, where
other versions may use them, until `unused` finds them.
"""

import re
import time
from collections import Counter
from collections.abc import Iterator

from sqlalchemy import Connection, delete, select
from stickslip_schemas.base import JobState, Sha256, is_sha256
from stickslip_schemas.store import Store, Stored

from stickslip_services.access.audit_log import note
from stickslip_services.catalog.versions import sealed_digests, stored_contents
from stickslip_services.database.database import Database, batches, rows_with
from stickslip_services.database.tables import (
    certificates,
    dataset_versions,
    datasets,
    events,
    idempotency_keys,
    job_counts,
    job_groups,
    job_stages,
    job_tasks,
    jobs,
    previews,
    samples,
    task_dependencies,
    tasks,
)
from stickslip_services.errors import ConflictError, NotFoundError
from stickslip_services.queue.ledger import TASK_COUNTS

_DIGEST = re.compile(r"[0-9a-f]{64}")


def remove(database: Database, store: Store, dataset: str, version: int) -> tuple[int, int]:
    """Remove a version; return the number of jobs and tasks that went with it.

    Raises NotFoundError where it does not exist, ConflictError where a job is making it.
    """
    with database.write() as connection:
        columns = dataset_versions.c
        own = (columns.dataset == dataset, columns.version == version)
        publish_task = connection.scalar(select(columns.publish_task).where(*own))
        if publish_task is None and not store.is_shown(dataset, version):
            raise NotFoundError(f"there is no version {version} of a dataset {dataset[:100]!r}")
        jobs_, tasks_ = 0, 0
        if publish_task is not None:
            jobs_, tasks_ = _remove_jobs(connection, publish_task)
            connection.execute(delete(dataset_versions).where(*own))
            if connection.scalar(select(columns.version).where(columns.dataset == dataset).limit(1)) is None:
                connection.execute(delete(datasets).where(datasets.c.id == dataset))
        note(connection, "version.remove", f"{dataset}:v{version}", time.time(), jobs=jobs_, tasks=tasks_)
    store.hide(dataset, version)  # last: a version that is in the database is always in the store
    return jobs_, tasks_


def _remove_jobs(connection: Connection, publish_task: int) -> tuple[int, int]:
    rows = connection.execute(
        select(jobs.c.seq, jobs.c.id, jobs.c.state).where(jobs.c.publish_task == publish_task)
    ).all()
    for row in rows:
        if JobState(row.state).is_open:
            raise ConflictError(f"the job {row.id} is {row.state} and makes this version: cancel it first")
    own = [row.seq for row in rows]
    held = set(connection.scalars(select(job_tasks.c.task).where(job_tasks.c.job.in_(own))))
    for table in (events, idempotency_keys, job_counts, job_stages, job_groups, samples, job_tasks):
        connection.execute(delete(table).where(table.c.job.in_(own)))
    connection.execute(delete(jobs).where(jobs.c.seq.in_(own)))
    still = {row.task for row in rows_with(connection, select(job_tasks.c.task), job_tasks.c.task, held)}
    lost = held - still  # a job has all dependencies of its tasks, too
    counts: Counter[tuple[str, str]] = Counter()
    for batch in batches(lost):
        of_batch = tasks.c.seq.in_(batch)
        counts.update(
            (row.stage, row.state) for row in connection.execute(select(tasks.c.stage, tasks.c.state).where(of_batch))
        )
        connection.execute(delete(task_dependencies).where(task_dependencies.c.task.in_(batch)))
        connection.execute(delete(previews).where(previews.c.task.in_(batch)))
        connection.execute(delete(tasks).where(of_batch))
    TASK_COUNTS.add(connection, {key: -count for key, count in counts.items()})
    return len(own), len(lost)


def unused(database: Database, store: Store, *, older_than: float) -> Iterator[Stored]:
    """Yield artifacts and temporary files without references, unchanged for `older_than` seconds.

    References are those of tasks, jobs, versions and certificates in the database, and of versions in the store.
    Raises CorruptArtifactError, OSError or ValueError where the manifest of a version cannot be read.
    """
    needed = _needed(database, store)
    latest = time.time() - older_than
    for file in store.stored():
        is_needed = is_sha256(file.name) and bytes.fromhex(file.name) in needed
        if not is_needed and not file.is_shown and file.modified_at < latest:
            yield file


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
        add(*connection.scalars(select(certificates.c.artifact)))
        columns = dataset_versions.c
        versions = connection.execute(
            select(columns.manifest, columns.group_digest).where(columns.manifest.is_not(None))
        )
        for manifest, group in versions.all():
            files = stored_contents(store, manifest).files()
            add(*sealed_digests(manifest, group).values(), *(file.sha256 for file in files))
    return needed
