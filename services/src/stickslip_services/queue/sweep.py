"""The coordinator's own work: at its start, at each sweep, once a second, and while no job runs: scrubbing.

Scrubbing reads whole datasets now and then, to find damaged files that are not read otherwise.
"""

import logging
from contextlib import suppress
from math import inf

from sqlalchemy import or_, select, update
from stickslip_schemas.base import JobState, Reason
from stickslip_schemas.format.manifest import MANIFEST_NAME, SIGNATURE_NAME, seal_text

from stickslip_services.access.keys import admit_local_worker
from stickslip_services.catalog.versions import damaged_files, mend_signature
from stickslip_services.database.opening import upgrade
from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import dataset_versions, jobs
from stickslip_services.errors import DamagedRowsError
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import pause, resume
from stickslip_services.queue.jobs import has_runnable_job
from stickslip_services.queue.lease import renew_all_leases
from stickslip_services.queue.ledger import RUNNABLE
from stickslip_services.queue.planner import plan_waiting_jobs, release_claims
from stickslip_services.queue.recompute import CHECKED_AT_ONCE, check_made_datasets, fail_damaged_jobs, read_plan
from stickslip_services.queue.retries import take_back
from stickslip_services.queue.workers import note_stranded
from stickslip_services.queue.write_plan import begin_planning, insert_job

logger = logging.getLogger(__name__)

EVERY_SECONDS = 30 * 24 * 3600.0
"""A coordinator reads each version once in this time [s]..."""
IDLE_RATE = 50e6
"""...while no job runs, and at this rate at most [bytes/s], a third of what a hard disk reads."""


def start(context: Context) -> None:
    """Bring the database up to date, and resume the work of an earlier process."""
    with context.database.write() as connection:
        upgrade(connection)
        admit_local_worker(connection, context.settings.worker_key_path, context.clock())
        if context.database.is_alone(connection):  # no other coordinator could have taken a heartbeat
            renew_all_leases(connection, context.clock(), context.settings.lease_seconds)
            release_claims(connection)
    plan_waiting_jobs(context)


def sweep(context: Context) -> None:
    """Watch the store, plan jobs that wait, take back expired leases, retry tasks, and update messages."""
    fail_damaged_jobs(context)
    _watch_store(context)
    plan_waiting_jobs(context)
    take_back(context)
    note_stranded(context)
    check_made_datasets(context, at_most=CHECKED_AT_ONCE)


_RUNNABLE_JOBS = Prepared(select(jobs).where(jobs.c.state.in_(RUNNABLE)))
_HELD_JOBS = Prepared(
    select(jobs)
    .where(jobs.c.state.in_((JobState.pausing, JobState.paused)), jobs.c.reason == Reason.store_unavailable)
    .order_by(jobs.c.seq)
)


def _watch_store(context: Context) -> None:
    """Pause jobs while the store takes no results, and resume them afterwards."""
    trouble = context.store_watch.look()
    due = _RUNNABLE_JOBS if trouble else _HELD_JOBS
    with context.database.read() as connection:
        if not due.tuples(connection):
            return
    message = f"{trouble}. Nothing more is started; the job goes on by itself as soon as the store takes results again"
    with context.ledger() as book:
        for job in due.rows(book.connection):
            if trouble:
                pause(book, job.seq, reason=Reason.store_unavailable, message=message)
            else:
                resume(book, job)
    logger.warning("jobs are paused: %s", trouble) if trouble else logger.info("the store takes results again")


def scrub(context: Context, *, before: float, rate: float = inf) -> tuple[str, list[str]] | None:
    """Read the version that was read longest ago, at `rate` [bytes/s]; return its name, and paths of damaged files.

    A damaged version gets a job with the terms that it was made with, which recomputes the files (`recompute`). With a
    signing key, a version without a good signature is signed again. Returns None if all versions were read since
    `before` [s]. Raises OSError where the store is out of reach, ClientError if the key cannot sign.
    """
    columns = dataset_versions.c
    is_due = or_(columns.scrubbed_at < before, columns.scrubbed_at > context.clock())  # by a clock that was ahead
    due = select(dataset_versions).where(columns.manifest.is_not(None), is_due)
    with context.database.read() as connection:
        row = connection.execute(due.order_by(columns.scrubbed_at, columns.publish_task).limit(1)).one_or_none()
    if row is None:
        return None
    found = damaged_files(context.store, row.manifest, row.group_digest, rate=rate)
    damaged = [MANIFEST_NAME] if found is None else sorted(found)
    with context.ledger() as book:
        own = update(dataset_versions).where(columns.publish_task == row.publish_task)
        book.connection.execute(own.values(scrubbed_at=book.now, damaged=len(damaged)))
        made = book.connection.execute(select(jobs).where(jobs.c.publish_task == row.publish_task)).all()
        if damaged and made and not any(JobState(job.state).is_open for job in made):
            with suppress(DamagedRowsError):  # then it is only named
                spec, terms = read_plan(book.connection, made[0].seq)
                job = insert_job(book, spec, project=made[0].project)
                begin_planning(book, job, terms)
    key, seal = context.settings.signing_key, seal_text(row.manifest, row.group_digest)
    if found is not None and key is not None and mend_signature(context.store, row.dataset, row.version, seal, key):
        damaged.append(SIGNATURE_NAME)
    return f"{row.dataset}:v{row.version}", damaged


def scrub_when_idle(context: Context) -> None:
    """Read a version that has not been read for `EVERY_SECONDS`, unless a job runs."""
    with context.database.read() as connection:
        is_busy = has_runnable_job(connection)
    if not is_busy:
        scrub(context, before=context.clock() - EVERY_SECONDS, rate=IDLE_RATE)
