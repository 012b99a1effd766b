"""Scrubbing: reading whole datasets now and then, to find damaged files that nobody else reads."""

from math import inf
from typing import NamedTuple

from sqlalchemy import or_, select, update
from stickslip_schemas.base import JobState
from stickslip_schemas.format.manifest import MANIFEST_NAME, SIGNATURE_NAME, seal_text

from stickslip_services.catalog.versions import damaged_files, mend_signature
from stickslip_services.database.statements import RowQuery, ValueQuery
from stickslip_services.database.tables import dataset_versions
from stickslip_services.errors import DamagedRowError
from stickslip_services.queue.context import Context
from stickslip_services.queue.documents import read_plan
from stickslip_services.queue.insertion import begin_planning, insert_job
from stickslip_services.queue.jobs import has_schedulable_job
from stickslip_services.queue.transaction import QueueTransaction

EVERY_SECONDS = 30 * 24 * 3600.0
"""Time in which a coordinator reads each version once [s]."""
IDLE_RATE = 50e6
"""Rate at which a coordinator reads while no job runs, at most [bytes/s].

It is a third of the rate of a hard disk.
"""


class _ScrubbedVersion(NamedTuple):
    """A committed version."""

    publish_task: int
    dataset: str
    version: int
    manifest: str
    group_digest: str


class _PublishingJob(NamedTuple):
    seq: int
    state: str
    project: str


_JOBS_OF_VERSION = RowQuery(
    _PublishingJob, "SELECT seq, state, project FROM jobs WHERE publish_task = :b_task ORDER BY seq"
)
_DUE: ValueQuery[int] = ValueQuery(
    "SELECT publish_task FROM dataset_versions WHERE manifest IS NOT NULL "
    "AND (scrubbed_at < :b_before OR scrubbed_at > :b_now) LIMIT 1"
)


def scrub(context: Context, *, before: float, rate: float = inf) -> tuple[str, list[str]] | None:
    """Read the version that was read longest ago, at `rate` [bytes/s].

    Returns its name, and the paths of damaged files. A damaged version gets a job with the builds
    that it was computed with, which recomputes the files (`existing_datasets`). With a signing key,
    a version without a good signature is signed again. Returns None if all versions were read since
    `before` [s]. Raises OSError if the store is out of reach, and ClientError if the key cannot
    sign.
    """
    version = _find_due(context, before)
    if version is None:
        return None
    files = damaged_files(context.store, version.manifest, version.group_digest, rate=rate)
    damaged = [MANIFEST_NAME] if files is None else sorted(files)
    with context.transaction() as tx:
        statement = update(dataset_versions).where(
            dataset_versions.c.publish_task == version.publish_task
        )
        tx.connection.execute(statement.values(scrubbed_at=tx.now, damaged=len(damaged)))
        if damaged:
            _recompute(tx, version.publish_task)

    key = context.settings.signing_key
    seal = seal_text(version.manifest, version.group_digest)
    if files is not None and key is not None:
        name = (version.dataset, version.version)
        if mend_signature(context.store, *name, seal, key):
            damaged.append(SIGNATURE_NAME)
    return f"{version.dataset}:v{version.version}", damaged


def _find_due(context: Context, before: float) -> _ScrubbedVersion | None:
    columns = dataset_versions.c
    # A time ahead was written by a clock that was ahead.
    is_due = or_(columns.scrubbed_at < before, columns.scrubbed_at > context.clock())
    query = (
        select(*(columns[name] for name in _ScrubbedVersion._fields))
        .where(columns.manifest.is_not(None), is_due)
        .order_by(columns.scrubbed_at, columns.publish_task)
        .limit(1)
    )
    with context.database.read() as connection:
        row = connection.execute(query).one_or_none()
    return None if row is None else _ScrubbedVersion(*row)


def _recompute(tx: QueueTransaction, publish_task: int) -> None:
    """Submit the job of a damaged version again, unless one is open."""
    earlier = _JOBS_OF_VERSION.rows(tx.connection, {"b_task": publish_task})
    if not earlier or any(JobState(job.state).is_open for job in earlier):
        return
    try:
        spec, inputs = read_plan(tx.connection, earlier[0].seq)
    except DamagedRowError:
        return  # the version is only reported
    job = insert_job(tx, spec, project=earlier[0].project)
    begin_planning(tx, job, inputs)


def scrub_when_idle(context: Context) -> None:
    """Read a version that has not been read for `EVERY_SECONDS`, unless a job runs."""
    before = context.clock() - EVERY_SECONDS
    with context.database.read() as connection:
        values = {"b_before": before, "b_now": context.clock()}
        if _DUE.first(connection, values) is None or has_schedulable_job(connection):
            return
    scrub(context, before=before, rate=IDLE_RATE)
