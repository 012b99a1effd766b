"""Maintenance of a stopped coordinator: versions, unused artifacts, and a lost database.

A removed version goes with the jobs that made it, and the tasks that no other job needs. Its files
stay in the store, where other versions may use them, until `unused` finds them.

A version in the store is identified by its manifest, the metadata of its root, and the seal that
binds both. For each intact version, `reindex` inserts the job that made it, so that the dataset is
listed and can be pulled, and a spec that is submitted again finds it. Results of single simulations
and renders, and certificates, are not restored.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass

from sqlalchemy import Connection, delete, select, update
from stickslip_schemas.base import JobState, Sha256, TaskState, is_sha256, sha256
from stickslip_schemas.documents.tasks import PublishOutput
from stickslip_schemas.format.manifest import (
    GROUP_NAME,
    MANIFEST_NAME,
    SEAL_NAME,
    Contents,
    Manifest,
    check_seal,
)
from stickslip_schemas.store import ShownVersion, Store, Stored, in_parallel

from stickslip_services.access import audit_log
from stickslip_services.catalog.versions import (
    commit_version,
    find_committed,
    read_version,
    reserve_number,
    sealed_digests,
    stored_contents,
)
from stickslip_services.database.database import Database
from stickslip_services.database.statements import batches, rows_with
from stickslip_services.database.tables import (
    certificates,
    dataset_versions,
    datasets,
    job_tasks,
    jobs,
    metadata,
    previews,
    task_dependencies,
    tasks,
)
from stickslip_services.errors import ConflictError, NotFoundError
from stickslip_services.queue.dependents import release_dependents
from stickslip_services.queue.insertion import begin_planning, insert_job, insert_piece
from stickslip_services.queue.integrity import result_digest
from stickslip_services.queue.job_states import complete_job, open_jobs_of
from stickslip_services.queue.plan import pieces
from stickslip_services.queue.ready import remove_ready
from stickslip_services.queue.rerun import DIGEST
from stickslip_services.queue.rows import PlanInputs
from stickslip_services.queue.totals import add_results
from stickslip_services.queue.transaction import QueueTransaction

PIECE = 10_000
"""Size of the pieces of a plan [samples]."""


def remove(database: Database, store: Store, dataset: str, version: int) -> tuple[int, int]:
    """Remove a version, and return the number of jobs and tasks that went with it.

    Raises NotFoundError if the version does not exist, and ConflictError if a job is making it.
    """
    with database.write() as connection:
        columns = dataset_versions.c
        is_version = (columns.dataset == dataset, columns.version == version)
        publish_task = connection.scalar(select(columns.publish_task).where(*is_version))
        if publish_task is None and not store.is_shown(dataset, version):
            raise NotFoundError(f"there is no version {version} of a dataset {dataset[:100]!r}")
        jobs_, tasks_ = 0, 0
        if publish_task is not None:
            jobs_, tasks_ = _remove_jobs(connection, publish_task)
            connection.execute(delete(dataset_versions).where(*is_version))
            if (
                connection.scalar(
                    select(columns.version).where(columns.dataset == dataset).limit(1)
                )
                is None
            ):
                connection.execute(delete(datasets).where(datasets.c.id == dataset))
        audit_log.append(
            connection,
            "version.remove",
            f"{dataset}:v{version}",
            time.time(),
            jobs=jobs_,
            tasks=tasks_,
        )
    store.hide(dataset, version)  # last: a version that is in the database is always in the store
    return jobs_, tasks_


def _remove_jobs(connection: Connection, publish_task: int) -> tuple[int, int]:
    rows = connection.execute(
        select(jobs.c.seq, jobs.c.id, jobs.c.state).where(jobs.c.publish_task == publish_task)
    ).all()
    for row in rows:
        if JobState(row.state).is_open:
            raise ConflictError(
                f"the job {row.id} is {row.state} and makes this version: cancel it first"
            )
    removed_jobs = [row.seq for row in rows]
    of_jobs = job_tasks.c.job.in_(removed_jobs)
    candidates = set(connection.scalars(select(job_tasks.c.task).where(of_jobs)))
    for table in metadata.sorted_tables:
        if "job" in table.c:
            connection.execute(delete(table).where(table.c.job.in_(removed_jobs)))
    connection.execute(delete(jobs).where(jobs.c.seq.in_(removed_jobs)))

    # A task stays if another job needs it. That job has all dependencies of its tasks, too.
    links = rows_with(connection, select(job_tasks.c.task), job_tasks.c.task, candidates)
    removed_tasks = candidates - {link.task for link in links}
    for batch in batches(removed_tasks):
        connection.execute(delete(task_dependencies).where(task_dependencies.c.task.in_(batch)))
        connection.execute(delete(previews).where(previews.c.task.in_(batch)))
        connection.execute(delete(tasks).where(tasks.c.seq.in_(batch)))
    return len(removed_jobs), len(removed_tasks)


def unused(database: Database, store: Store, *, older_than: float) -> Iterator[Stored]:
    """Yield artifacts and temporary files without references, unchanged for `older_than` seconds.

    Tasks, jobs, versions and certificates in the database refer to artifacts, and so do versions in
    the store. Raises CorruptArtifactError, OSError or ValueError if the manifest of a version
    cannot be read.
    """
    needed = needed_artifacts(database, store)
    latest = time.time() - older_than
    for file in store.stored():
        is_needed = is_sha256(file.name) and bytes.fromhex(file.name) in needed
        if not is_needed and not file.is_shown and file.modified_at < latest:
            yield file


def needed_artifacts(database: Database, store: Store) -> set[bytes]:
    """Return the digests of all artifacts that the database refers to."""
    needed: set[bytes] = set()

    def add(*digests: Sha256 | None) -> None:
        needed.update(bytes.fromhex(digest) for digest in digests if digest)

    with database.read() as connection:
        for texts in connection.execute(select(tasks.c.output, tasks.c.payload)):
            for text in texts:
                add(*DIGEST.findall(text or ""))
        add(*connection.scalars(select(previews.c.digest)))
        for manifest, spec in connection.execute(select(jobs.c.manifest, jobs.c.spec)):
            add(
                manifest, *DIGEST.findall(spec)
            )  # a spec names textures, also before its tasks are planned
        add(*connection.scalars(select(certificates.c.artifact)))
        columns = dataset_versions.c
        versions = connection.execute(
            select(columns.manifest, columns.group_digest).where(columns.manifest.is_not(None))
        )
        for manifest, group in versions.all():
            files = stored_contents(store, manifest).files()
            add(*sealed_digests(manifest, group).values(), *(file.sha256 for file in files))
    return needed


@dataclass(frozen=True, slots=True)
class IndexedVersion:
    """A version of the store, and whether it was inserted."""

    name: str
    """Dataset and version, as in `ds-0123456789abcdef:v1`."""
    samples: int
    fault: str
    """The reason why it was left out, or an empty text."""
    is_new: bool = True


def reindex(database: Database, store: Store) -> Iterator[IndexedVersion]:
    """Insert the versions that only the store has, one transaction each.

    Yields all versions of the store.
    """
    for version in store.versions(MANIFEST_NAME):
        name = f"{version.dataset}:v{version.version}"
        try:
            manifest, output = _read(store, version)
        except (OSError, ValueError) as error:
            yield IndexedVersion(name, 0, str(error).splitlines()[0])
            continue
        is_new = _insert(database, store, manifest, output, version.modified_at)
        yield IndexedVersion(name, manifest.sample_count, "", is_new)


def _read(store: Store, version: ShownVersion) -> tuple[Manifest, PublishOutput]:
    """Read a version, and restore lost artifacts from the files of the version."""
    place = version.dataset, version.version
    content, group, seal = (
        store.read_shown(*place, name) for name in (MANIFEST_NAME, GROUP_NAME, SEAL_NAME)
    )
    check_seal(content, group, seal)
    manifest = Manifest.model_validate_json(content)
    if (manifest.spec.dataset_id, manifest.version) != place:
        raise ValueError(f"the manifest is that of {manifest.spec.dataset_id}, v{manifest.version}")
    digests = sealed_digests(sha256(content), sha256(group))
    listed = list(Contents(manifest, lambda file: store.read_shown(*place, file.path)).files())

    def put_back(entry: tuple[str, Sha256]) -> None:
        path, digest = entry
        if not store.exists(digest, size=1):
            store.publish(store.read_shown(*place, path))

    in_parallel(put_back, (digests | {file.path: file.sha256 for file in listed}).items())
    size = sum(file.size for file in listed) + len(content) + len(group) + len(seal)
    output = PublishOutput(manifest=digests[MANIFEST_NAME], group=digests[GROUP_NAME], bytes=size)
    read_version(store, output)  # every file is there
    return manifest, output


def _insert(
    database: Database, store: Store, manifest: Manifest, output: PublishOutput, made_at: float
) -> bool:
    """Insert a version as the result of an ended job.

    Returns False if the version is known.
    """
    inputs = PlanInputs(manifest.builds, manifest.certificate)
    with database.write() as connection:
        known = select(dataset_versions).filter_by(
            dataset=manifest.dataset, version=manifest.version
        )
        if connection.execute(known).first() is not None:
            return False
        tx = QueueTransaction(connection, made_at)
        job = insert_job(tx, manifest.spec)
        begin_planning(tx, job, inputs)
        for piece in pieces(manifest.spec, inputs, size=PIECE):
            insert_piece(tx, job, piece)
        task = connection.scalar(select(jobs.c.publish_task).where(jobs.c.seq == job))
        assert task is not None, "a planned job has a publish task"
        _store_publish_result(tx, task, output)
        reserve_number(connection, manifest.dataset, manifest.version, task)
        commit_version(connection, task, manifest, output, name=manifest.spec.name, now=made_at)
        version = find_committed(connection, task)
        for waiting in open_jobs_of(connection, task):
            complete_job(tx, waiting, version, "found again in the store")
    return True


def _store_publish_result(tx: QueueTransaction, task: int, output: PublishOutput) -> None:
    """Store the result of a publish task whose dependencies have none."""
    key = tx.connection.execute(select(tasks.c.key).where(tasks.c.seq == task)).scalar_one()
    text = output.model_dump_json()
    succeeded = TaskState.succeeded
    tx.connection.execute(
        update(tasks)
        .where(tasks.c.seq == task)
        .values(
            state=succeeded,
            output=text,
            digest=result_digest(key, succeeded, None, "", text),
            finished_at=tx.now,
        )
    )
    remove_ready(tx.connection, [task])
    add_results(tx.connection, [task])
    release_dependents(tx, [task])
