"""Submission of jobs, what a job of a spec would be, and planning in the background.

Jobs that waited for the first worker, and jobs of many samples, are planned later. A job of many
samples is planned piece by piece, each piece in a transaction of its own. Of several coordinators
one plans a job at a time: it claims the job, and renews the claim with each piece. When it dies,
another coordinator, or its successor, continues after the last piece that was written.
"""

import json
import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

from sqlalchemy import Connection, Row, func, insert, or_, select, update
from sqlalchemy.exc import SQLAlchemyError
from stickslip_schemas.base import JobState, Reason, Stage, sha256
from stickslip_schemas.documents.responses import JobDetail, Validation
from stickslip_schemas.format.manifest import bytes_estimate
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.costs import Counts, Interval, count, estimate_cost
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.access import audit_log
from stickslip_services.access.principals import current_principal
from stickslip_services.access.quotas import check_quota
from stickslip_services.catalog.inputs import check_files
from stickslip_services.database.database import Database, Prepared, batches, document_of
from stickslip_services.database.tables import (
    dataset_versions,
    idempotency_keys,
    job_stages,
    job_tasks,
    jobs,
    tasks,
)
from stickslip_services.errors import (
    IdempotencyKeyReusedError,
    KindNotAvailableError,
    PresetNotCertifiedError,
)
from stickslip_services.queue.context import Context
from stickslip_services.queue.eta import StageWork, estimate, known_timings, read_costs
from stickslip_services.queue.ids import new_id
from stickslip_services.queue.jobs import show_job, unplanned_jobs
from stickslip_services.queue.plan import (
    Plan,
    Terms,
    begin_planning,
    expand,
    insert_job,
    pieces,
    terms_for,
    write_plan,
)
from stickslip_services.queue.recompute import CHECKED_AT_ONCE, check_made_datasets, terms_of
from stickslip_services.queue.transaction import SETTLED, queue_transaction
from stickslip_services.queue.workers import NO_WORKER, alive_workers, mean_speed, present_workers

logger = logging.getLogger(__name__)

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
    """Make a job of a spec, or return the answer to an earlier request with the same idempotency
    key.

    Raises UnknownFileError, QuotaExceededError, KindNotAvailableError, PresetNotCertifiedError, or
    IdempotencyKeyReusedError.
    """
    check_files(context.database, context.store, spec)
    project, print_ = current_principal().project, sha256(spec.model_dump_json().encode())
    with context.database.write() as connection:
        if replay := _find_replay(connection, idempotency_key, print_):
            return replay
        check_quota(connection, project, spec.sample_count)
        terms, now = terms_for(connection, spec), context.clock()
        with queue_transaction(connection, now) as tx:
            job = insert_job(tx, spec, priority=priority, project=project)
            if terms is None:
                tx.set_job_state(
                    job, JobState.queued, reason=Reason.waiting_for_worker, message=NO_WORKER
                )
            else:
                begin_planning(tx, job, terms, plan_at_once(context, spec, terms))
        shown = show_job(context, connection, job)
        details = {"name": spec.name, "samples": spec.sample_count, "priority": priority}
        audit_log.append(connection, "job.submit", shown.id, now, **details)
        if idempotency_key:
            row = {
                "project": project,
                "key": idempotency_key,
                "fingerprint": print_,
                "job": job,
                "created_at": now,
            }
            connection.execute(
                insert(idempotency_keys).values(row | {"response": shown.model_dump_json()})
            )
    context.notifier.notify()
    check_made_datasets(context, at_most=CHECKED_AT_ONCE)
    return shown


def _find_replay(connection: Connection, key: str | None, fingerprint: str) -> Replay | None:
    """Return the answer to an earlier request with this key.

    Raise IdempotencyKeyReusedError for another document.
    """
    if not key:
        return None
    row = connection.execute(
        select(idempotency_keys.c.fingerprint, idempotency_keys.c.response, jobs.c.id)
        .join(jobs, jobs.c.seq == idempotency_keys.c.job)
        .where(
            idempotency_keys.c.key == key, idempotency_keys.c.project == current_principal().project
        )
    ).one_or_none()
    if row is None:
        return None
    if row.fingerprint != fingerprint:
        raise IdempotencyKeyReusedError(
            f"the Idempotency-Key {key!r} came with another document before"
        )
    return Replay(row.id, row.response)


def validate_spec(context: Context, spec: JobSpec) -> Validation:
    """Return counts and sizes of a job of `spec`, and why it would be refused, if so, without
    making one.

    Counts come from arithmetic, so that a grid of a million samples costs nothing. Raises
    UnknownFileError.
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
        workers = alive_workers(context, connection)
        slots = sum(worker.condition.slots for worker in workers)
    return document_of(
        Validation,
        counts,
        spec=spec,
        spec_digest=spec.content_digest,
        cached_count=None if terms is None else _cached(database, spec, terms),
        bytes_estimate=raw,
        stored_bytes_estimate=None if compression is None else round(raw * compression),
        estimate=estimate_cost(spec, counts, measured, slots, mean_speed(workers)),
        certificate=None if terms is None else terms.certificate,
        refusal=refusal,
    )


def _measured(connection: Connection, spec: JobSpec, counts: Counts) -> dict[Stage, Interval]:
    """Return what the stages cost of which tasks were measured."""
    costs, points = read_costs(connection), list(islice(spec.grid(), LOOKED_UP))
    work = {Stage.pack: [StageWork(counts.shards, known_timings(costs, Stage.pack, spec.kind, ""))]}
    for stage, number in (
        (Stage.simulate, counts.simulation_count),
        (Stage.render, counts.render_count),
    ):
        groups = Counter(spec.cost_group(stage, point) for point in points)
        work[stage] = [
            StageWork(number * share / len(points), known_timings(costs, stage, spec.kind, group))
            for group, share in groups.items()
        ]
    kept = (
        job_stages.c
    )  # groups have slot time, whose share of CPU time is that of all jobs of the kind
    spent = select(kept.stage, func.sum(kept.cpu_seconds) / func.sum(kept.wall_sum)).join(
        jobs, jobs.c.seq == kept.job
    )
    share: dict[str, float] = dict(
        connection.execute(
            spent.where(jobs.c.kind == spec.kind, kept.wall_sum > 0).group_by(kept.stage)
        ).all()
    )
    known = [
        stage for stage, items in work.items() if all(item.timings is not None for item in items)
    ]
    found = [
        (estimate({stage: work[stage]}, slots=1), stage, share.get(stage, 1.0)) for stage in known
    ]
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
            connection.scalar(
                select(func.count()).where(tasks.c.key.in_(batch), tasks.c.state.in_(SETTLED))
            )
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
    return (
        None
        if row is None
        else row.bytes / bytes_estimate(job_spec_adapter.validate_json(row.spec))
    )


_WAITING = Prepared(select(jobs.c.seq).where(jobs.c.state == JobState.planning).limit(1))


def release_claims(connection: Connection) -> None:
    """Release the claims of all planners; only for a coordinator that is alone on its database."""
    connection.execute(
        update(jobs).where(jobs.c.planner.is_not(None)).values(planner=None, planner_until=None)
    )


def plan_waiting_jobs(context: Context) -> None:
    """Plan the jobs that were submitted before the first worker registered, or fail those that
    cannot be planned.
    """
    with context.database.read() as connection:
        waiting = unplanned_jobs(connection)
        is_known = any(worker.builds for worker in present_workers(connection))
    for row in waiting if is_known else ():
        with context.transaction() as tx:
            if row.seq not in {other.seq for other in unplanned_jobs(tx.connection)}:
                continue  # cancelled, or planned by another coordinator
            try:
                spec, _ = terms_of(row)
                if (terms := terms_for(tx.connection, spec)) is None:
                    return
                begin_planning(tx, row.seq, terms, plan_at_once(context, spec, terms))
            except (KindNotAvailableError, PresetNotCertifiedError) as error:
                is_preset = isinstance(error, PresetNotCertifiedError)
                reason = Reason.preset_not_certified if is_preset else Reason.waiting_for_worker
                tx.set_job_state(row.seq, JobState.failed, reason=reason, message=str(error))


def plan_at_once(context: Context, spec: JobSpec, terms: Terms) -> Plan | None:
    """Return the plan of a job of few samples; None of one that is planned piece by piece."""
    if spec.sample_count > context.settings.plan_samples:
        return None
    return expand(spec, terms, previews=context.settings.previews_per_job)


class Planner:
    """Plans the jobs that are `planning`: those of the highest priority first, and of these the
    oldest.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._name = new_id("planner")
        self._job: int | None = None
        self._end = 0
        self._pieces: Iterator[Plan] = iter(())

    def run(self) -> None:
        """Plan until no job is `planning`, or the coordinator closes."""
        while not self._context.is_closing and self.step():
            pass

    def step(self) -> bool:
        """Plan a piece of a job; return whether there was any to plan."""
        with self._context.database.read() as connection:
            if _WAITING.scalar(connection) is None:
                return False
        with self._context.database.write() as connection:
            row = self._claim(connection)
            packed = [] if row is None or self._goes_on(row) else _pack_keys(connection, row.seq)
        if row is None:
            self._job, self._pieces = None, iter(())
            return False
        try:
            if not self._goes_on(row):
                self._pieces = self._begin(row, packed)
            self._write(row.seq, next(self._pieces))
        except Exception as error:
            self._job = None
            if isinstance(error, OSError | SQLAlchemyError):
                raise  # the disk or the database: it may work the next time
            logger.exception("job %s cannot be planned", row.id)
            self._fail(row, error)
        return True

    def _claim(self, connection: Connection) -> Row[tuple[object, ...]] | None:
        """Claim a job that nobody plans, or whose claim is over, and return its row."""
        now = self._context.clock()
        free = or_(
            jobs.c.planner.is_(None), jobs.c.planner == self._name, jobs.c.planner_until <= now
        )
        row = connection.execute(
            select(jobs)
            .where(jobs.c.state == JobState.planning, free)
            .order_by(jobs.c.priority.desc(), jobs.c.seq)
            .limit(1)
        ).one_or_none()
        if row is not None:
            until = now + self._context.settings.lease_seconds
            connection.execute(
                update(jobs)
                .where(jobs.c.seq == row.seq)
                .values(planner=self._name, planner_until=until)
            )
        return row

    def _goes_on(self, row: Row[tuple[object, ...]]) -> bool:
        return (row.seq, row.planned) == (self._job, self._end)

    def _begin(self, row: Row[tuple[object, ...]], packed: list[str]) -> Iterator[Plan]:
        spec, terms = terms_of(row)
        assert terms is not None
        self._job, self._end = row.seq, row.planned
        return pieces(
            spec,
            terms,
            size=self._context.settings.plan_samples,
            previews=self._context.settings.previews_per_job,
            first=row.planned,
            packed=packed,
        )

    def _write(self, job: int, piece: Plan) -> None:
        with self._context.transaction() as tx:
            still = (
                jobs.c.seq == job,
                jobs.c.state == JobState.planning,
                jobs.c.planner == self._name,
            )
            if tx.connection.scalar(select(jobs.c.planned).where(*still)) != piece.first:
                # paused, cancelled or failed meanwhile, or another coordinator goes on with it
                self._job = None
                return
            write_plan(tx, job, piece)
        self._end = piece.end
        if (
            piece.is_last or piece.end.bit_length() > piece.first.bit_length()
        ):  # at each power of two
            self._context.database.analyse()

    def _fail(self, row: Row[tuple[object, ...]], error: Exception) -> None:
        message = f"planning it failed after {row.planned} of {row.sample_count} samples: {error}"[
            :2000
        ]
        with self._context.transaction() as tx:
            if (
                tx.connection.scalar(select(jobs.c.state).where(jobs.c.seq == row.seq))
                == JobState.planning
            ):
                tx.end_job(row.seq, JobState.failed, Reason.internal_error, message)


def _pack_keys(connection: Connection, job: int) -> list[str]:
    """Return the keys of the pack tasks that a job has so far, by shard."""
    rows = connection.execute(
        select(tasks.c.key, tasks.c.payload)
        .join(job_tasks, job_tasks.c.task == tasks.c.seq)
        .where(job_tasks.c.job == job, tasks.c.stage == Stage.pack)
    )
    by_shard = {json.loads(payload)["shard"]: key.hex() for key, payload in rows}
    return [by_shard[shard] for shard in sorted(by_shard)]
