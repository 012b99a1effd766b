"""Scrubbing: reading whole datasets now and then, to find damaged files that are not read otherwise."""

from contextlib import suppress
from math import inf

from sqlalchemy import or_, select, update
from stickslip_schemas.base.states import JobState
from stickslip_schemas.format.manifest import MANIFEST_NAME, SIGNATURE_NAME, seal_text

from stickslip_services.catalog.versions import damaged_files, mend_signature
from stickslip_services.database.tables import dataset_versions, jobs
from stickslip_services.errors import DamagedRowsError
from stickslip_services.queue.context import Context
from stickslip_services.queue.jobs import has_runnable_job
from stickslip_services.queue.recompute import read_plan
from stickslip_services.queue.write_plan import begin_planning, insert_job

EVERY_SECONDS = 30 * 24 * 3600.0
"""A coordinator reads each version once in this time [s]..."""
IDLE_RATE = 50e6
"""...while no job runs, and at this rate at most [bytes/s], a third of what a hard disk reads."""


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
