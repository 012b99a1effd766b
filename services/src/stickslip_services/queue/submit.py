"""Submission of jobs: checks, idempotency, planning at once or later, and what a job of a spec would be."""

from collections import Counter
from dataclasses import dataclass
from itertools import islice

from sqlalchemy import Connection, func, insert, select
from stickslip_schemas.base import JobState, Reason, Stage, sha256
from stickslip_schemas.documents.responses import JobDetail, Validation
from stickslip_schemas.format.manifest import bytes_estimate
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.points import Counts, Interval, count, estimated
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.access.asker import this_asker
from stickslip_services.access.audit_log import note
from stickslip_services.access.projects import check_quota
from stickslip_services.catalog.uploads import check_files
from stickslip_services.database.database import Database, batches
from stickslip_services.database.paging import document_of
from stickslip_services.database.tables import dataset_versions, idempotency_keys, job_stages, jobs, tasks
from stickslip_services.errors import IdempotencyKeyReusedError, KindNotAvailableError, PresetNotCertifiedError
from stickslip_services.queue.context import Context
from stickslip_services.queue.eta import StageWork, estimate, read_costs, timings_of
from stickslip_services.queue.jobs import show_job
from stickslip_services.queue.ledger import SETTLED, ledger
from stickslip_services.queue.plan import Terms, expand, terms_for
from stickslip_services.queue.planner import plan_at_once
from stickslip_services.queue.recompute import CHECKED_AT_ONCE, check_made_datasets
from stickslip_services.queue.workers import NO_WORKER, alive_workers
from stickslip_services.queue.write_plan import begin_planning, insert_job

LOOKED_UP = 10_000
"""The largest grid whose tasks are looked up one by one for existing results."""


@dataclass(frozen=True, slots=True)
class Replay:
    """The answer to the first request with an idempotency key."""

    job_id: str
    response: str


def submit_job(
    context: Context, spec: JobSpec, idempotency_key: str | None = None, *, priority: int = 0
) -> JobDetail | Replay:
    """Make a job of a spec, or return the answer to an earlier request with the same idempotency key.

    Raises UnknownFileError, QuotaExceededError, KindNotAvailableError, PresetNotCertifiedError, or
    IdempotencyKeyReusedError.
    """
    check_files(context.database, context.store, spec)
    project, print_ = this_asker().project, sha256(spec.model_dump_json().encode())
    with context.database.write() as connection:
        if replay := _find_replay(connection, idempotency_key, print_):
            return replay
        check_quota(connection, project, spec.sample_count)
        terms, now = terms_for(connection, spec), context.clock()
        with ledger(connection, now) as book:
            job = insert_job(book, spec, priority=priority, project=project)
            if terms is None:
                book.set_state(job, JobState.queued, reason=Reason.waiting_for_worker, message=NO_WORKER)
            else:
                begin_planning(book, job, terms, plan_at_once(context, spec, terms))
        shown = show_job(context, connection, job)
        details = {"name": spec.name, "samples": spec.sample_count, "priority": priority}
        note(connection, "job.submit", shown.id, now, **details)
        if idempotency_key:
            row = {"project": project, "key": idempotency_key, "fingerprint": print_, "job": job, "created_at": now}
            connection.execute(insert(idempotency_keys).values(row | {"response": shown.model_dump_json()}))
    context.notifier.notify()
    check_made_datasets(context, at_most=CHECKED_AT_ONCE)
    return shown


def _find_replay(connection: Connection, key: str | None, fingerprint: str) -> Replay | None:
    """Return the answer to an earlier request with this key; raise IdempotencyKeyReusedError for another document."""
    if not key:
        return None
    row = connection.execute(
        select(idempotency_keys.c.fingerprint, idempotency_keys.c.response, jobs.c.id)
        .join(jobs, jobs.c.seq == idempotency_keys.c.job)
        .where(idempotency_keys.c.key == key, idempotency_keys.c.project == this_asker().project)
    ).one_or_none()
    if row is None:
        return None
    if row.fingerprint != fingerprint:
        raise IdempotencyKeyReusedError(f"the Idempotency-Key {key!r} came with another document before")
    return Replay(row.id, row.response)


def validate_spec(context: Context, spec: JobSpec) -> Validation:
    """Return counts and sizes of a job of `spec`, and why it would be refused, if so, without making one.

    Counts come from arithmetic, so that a grid of a million samples costs nothing. Raises UnknownFileError.
    """
    check_files(context.database, context.store, spec)
    database = context.database
    counts = count(spec)
    raw = bytes_estimate(spec)
    terms, refusal = None, None
    with database.read() as connection:
        try:
            terms = terms_for(connection, spec)
        except (KindNotAvailableError, PresetNotCertifiedError) as error:
            refusal = str(error)
        compression = _compression(connection, spec.kind)
        measured = _measured(connection, spec, counts)
        slots = sum(worker.condition.slots for worker in alive_workers(context, connection))
    return document_of(
        Validation,
        counts,
        spec=spec,
        spec_digest=spec.content_digest,
        cached_count=None if terms is None else _cached(database, spec, terms),
        bytes_estimate=raw,
        stored_bytes_estimate=None if compression is None else round(raw * compression),
        estimate=estimated(spec, counts, measured, slots),
        certificate=None if terms is None else terms.certificate,
        refusal=refusal,
    )


def _measured(connection: Connection, spec: JobSpec, counts: Counts) -> dict[Stage, Interval]:
    """Return what the stages cost of which tasks were measured."""
    costs, points = read_costs(connection), list(islice(spec.grid(), LOOKED_UP))
    work = {Stage.pack: [StageWork(counts.shards, timings_of(costs, Stage.pack, spec.kind, ""))]}
    for stage, number in ((Stage.simulate, counts.simulation_count), (Stage.render, counts.render_count)):
        groups = Counter(spec.cost_group(stage, point) for point in points)
        work[stage] = [
            StageWork(number * share / len(points), timings_of(costs, stage, spec.kind, group))
            for group, share in groups.items()
        ]
    kept = job_stages.c  # groups have slot time, whose share of CPU time is that of all jobs of the kind
    spent = select(kept.stage, func.sum(kept.cpu_seconds) / func.sum(kept.wall_sum)).join(jobs, jobs.c.seq == kept.job)
    share: dict[str, float] = dict(
        connection.execute(spent.where(jobs.c.kind == spec.kind, kept.wall_sum > 0).group_by(kept.stage)).all()
    )
    known = [stage for stage, items in work.items() if all(item.timings is not None for item in items)]
    found = [(estimate({stage: work[stage]}, slots=1), stage, share.get(stage, 1.0)) for stage in known]
    return {
        stage: Interval(median=cpu * eta.seconds, low=cpu * eta.low, high=cpu * eta.high)
        for eta, stage, cpu in found
        if eta
    }


def _cached(database: Database, spec: JobSpec, terms: Terms) -> int | None:
    """Return the number of tasks that have a result; None if the grid is too large to look them up."""
    with database.read() as connection:
        planned_so = (jobs.c.kind == spec.kind, jobs.c.builds == terms.builds.model_dump_json())
        if connection.scalar(select(jobs.c.seq).where(*planned_so).limit(1)) is None:
            return 0
        if spec.sample_count > LOOKED_UP:
            return None
    plan = expand(spec, terms)
    with database.read() as connection:
        found = (
            connection.scalar(select(func.count()).where(tasks.c.key.in_(batch), tasks.c.state.in_(SETTLED)))
            for batch in batches(plan.tasks)
        )
        return sum(number or 0 for number in found)


def _compression(connection: Connection, kind: str) -> float | None:
    """Return stored bytes over raw bytes of the newest dataset of a kind; None if there is none."""
    row = connection.execute(
        select(jobs.c.spec, dataset_versions.c.bytes)
        .join(dataset_versions, dataset_versions.c.publish_task == jobs.c.publish_task)
        .where(jobs.c.kind == kind, dataset_versions.c.manifest.is_not(None))
        .order_by(dataset_versions.c.created_at.desc())
        .limit(1)
    ).one_or_none()
    return None if row is None else row.bytes / bytes_estimate(job_spec_adapter.validate_json(row.spec))
