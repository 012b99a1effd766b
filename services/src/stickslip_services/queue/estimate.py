"""A job of a spec before its submission: counts, sizes, time, and the reason for a refusal."""

from collections import Counter
from collections.abc import Mapping
from itertools import islice

from sqlalchemy import Connection, LargeBinary, bindparam, func, select, text
from stickslip_schemas.base import Stage
from stickslip_schemas.documents.responses import Validation
from stickslip_schemas.format.manifest import bytes_estimate
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.costs import Counts, Interval, count, estimate_cost
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.catalog.inputs import check_files
from stickslip_services.database.database import Database, document_of
from stickslip_services.database.statements import ValueQuery, batches
from stickslip_services.database.tables import dataset_versions, job_totals, jobs
from stickslip_services.errors import KindNotAvailableError, PresetNotCertifiedError
from stickslip_services.queue.context import Context
from stickslip_services.queue.eta import StageWork, estimate, known_timings, read_costs
from stickslip_services.queue.plan import expand, plan_inputs_for
from stickslip_services.queue.rows import PlanInputs
from stickslip_services.queue.workers import alive_workers, mean_speed

MAX_LOOKUPS = 10_000
"""The largest grid whose tasks are looked up one by one for existing results [samples]."""


def validate_spec(context: Context, spec: JobSpec) -> Validation:
    """Return counts and sizes of a job of `spec`, and the reason if it would be refused.

    Counts come from arithmetic, so a grid of a million samples costs nothing. Raises
    UnknownFileError.
    """
    check_files(context.database, context.store, spec)
    counts = count(spec)
    raw_bytes = bytes_estimate(spec)
    inputs: PlanInputs | None = None
    refusal: str | None = None
    with context.database.read() as connection:
        # A refusal is part of the answer: the user sees counts and sizes all the same.
        try:
            inputs = plan_inputs_for(connection, spec)
        except (KindNotAvailableError, PresetNotCertifiedError) as error:
            refusal = str(error)
        compression = _compression(connection, spec.kind)
        measured = _measured_costs(connection, spec, counts)
        workers = alive_workers(context, connection)
    slots = sum(worker.condition.slots for worker in workers)

    cached_count = None if inputs is None else _count_cached(context.database, spec, inputs)
    stored_bytes = None if compression is None else round(raw_bytes * compression)
    return document_of(
        Validation,
        counts,
        spec=spec,
        spec_digest=spec.content_digest,
        cached_count=cached_count,
        bytes_estimate=raw_bytes,
        stored_bytes_estimate=stored_bytes,
        estimate=estimate_cost(spec, counts, measured, slots, mean_speed(workers)),
        certificate=None if inputs is None else inputs.certificate,
        refusal=refusal,
    )


def _measured_costs(connection: Connection, spec: JobSpec, counts: Counts) -> dict[Stage, Interval]:
    """Return the CPU time of the stages whose tasks were measured [s]."""
    costs = read_costs(connection)
    # The first points of a large grid stand for the rest of it.
    points = list(islice(spec.grid(), MAX_LOOKUPS))
    pack_timings = known_timings(costs, Stage.pack, spec.kind, "")
    work = {Stage.pack: [StageWork(counts.shards, pack_timings)]}
    task_counts = {Stage.simulate: counts.simulation_count, Stage.render: counts.render_count}
    for stage, number in task_counts.items():
        groups = Counter(spec.cost_group(stage, point) for point in points)
        work[stage] = []
        for group, points_of_group in groups.items():
            tasks_of_group = number * points_of_group / len(points)
            timings = known_timings(costs, stage, spec.kind, group)
            work[stage].append(StageWork(tasks_of_group, timings))

    cpu_ratio = _cpu_ratio(connection, spec.kind)
    intervals: dict[Stage, Interval] = {}
    for stage, items in work.items():
        # One unknown cost group makes the sum of the stage unknown.
        if any(item.timings is None for item in items):
            continue
        # One slot gives the sum of the durations.
        eta = estimate({stage: items}, slots=1)
        if eta:
            ratio = cpu_ratio.get(stage, 1.0)
            intervals[stage] = Interval(
                median=ratio * eta.seconds, low=ratio * eta.low, high=ratio * eta.high
            )
    return intervals


def _cpu_ratio(connection: Connection, kind: str) -> Mapping[str, float]:
    """Return CPU time over slot time by stage, of all jobs of a kind.

    Cost groups have slot time only.
    """
    totals = job_totals.c
    ratio = func.sum(totals.cpu_seconds) / func.sum(totals.wall_sum)
    query = select(totals.stage, ratio).join(jobs, jobs.c.seq == totals.job)
    is_measured = (jobs.c.kind == kind, totals.wall_sum > 0)
    ratios: dict[str, float] = {}
    for stage, value in connection.execute(query.where(*is_measured).group_by(totals.stage)):
        ratios[stage] = value
    return ratios


_CACHED_COUNT: ValueQuery[int] = ValueQuery(
    text(
        "SELECT count(*) FROM tasks WHERE key IN :b_keys AND state IN ('succeeded', 'rejected')"
    ).bindparams(bindparam("b_keys", type_=LargeBinary, expanding=True))
)


def _count_cached(database: Database, spec: JobSpec, inputs: PlanInputs) -> int | None:
    """Return the number of tasks that have a result, or None if the grid is too large to look."""
    with database.read() as connection:
        builds = inputs.builds.model_dump_json()
        same_builds = (jobs.c.kind == spec.kind, jobs.c.builds == builds)
        # The builds are part of every task's key. Without a job of the same builds no task is
        # known, and the plan need not be made.
        if connection.scalar(select(jobs.c.seq).where(*same_builds).limit(1)) is None:
            return 0
    if spec.sample_count > MAX_LOOKUPS:
        return None
    plan = expand(spec, inputs)
    cached = 0
    with database.read() as connection:
        for batch in batches(plan.tasks):
            cached += _CACHED_COUNT.first(connection, {"b_keys": batch}) or 0
    return cached


def _compression(connection: Connection, kind: str) -> float | None:
    """Return stored bytes over raw bytes of the newest dataset of a kind, or None without one."""
    row = connection.execute(
        select(jobs.c.spec, dataset_versions.c.bytes)
        .join(dataset_versions, dataset_versions.c.publish_task == jobs.c.publish_task)
        .where(jobs.c.kind == kind, dataset_versions.c.manifest.is_not(None))
        .order_by(dataset_versions.c.created_at.desc())
        .limit(1)
    ).one_or_none()
    if row is None:
        return None
    return float(row.bytes / bytes_estimate(job_spec_adapter.validate_json(row.spec)))
