"""Totals of results by job, stage and cost group (`job_totals`), and counts of tasks in flight.

A total changes once a task: when it gets its result, or when that is discarded. Leases, retries and
pauses change none. Tasks in flight (on lease, or waiting for a retry) are few: they are counted
when somebody asks, from their side, by indexes that have no others. All other tasks are pending.

The totals of a job that has ended stay as they were. Its pending tasks are shown as `cancelled`.
"""

from collections import Counter
from collections.abc import Collection, Iterable
from typing import NamedTuple

from sqlalchemy import Connection, bindparam, text
from stickslip_schemas.base import Stage, TaskState

from stickslip_services.database.statements import RowQuery, Statement, batches


class _Results(NamedTuple):
    """The results of some tasks for one job, stage and cost group."""

    b_job: int
    b_stage: str
    b_group: str
    b_succeeded: int
    b_rejected: int
    b_failed: int
    b_cpu: float
    b_wall_count: int
    b_wall: float
    b_wall_squares: float
    b_updated: float | None


# The cost of a task is that of the jobs for which it ran: not of one that found the result.
_RESULTS_BY_JOB = RowQuery(
    _Results,
    text(
        "SELECT job_tasks.job, tasks.stage, tasks.cost_group, "
        "sum(CASE WHEN tasks.state = 'succeeded' THEN 1 ELSE 0 END), "
        "sum(CASE WHEN tasks.state = 'rejected' THEN 1 ELSE 0 END), "
        "sum(CASE WHEN tasks.state = 'failed' THEN 1 ELSE 0 END), "
        "coalesce(sum(CASE WHEN job_tasks.cached THEN 0 ELSE tasks.cpu_seconds END), 0.0), "
        "count(CASE WHEN job_tasks.cached THEN NULL ELSE tasks.wall_seconds END), "
        "coalesce(sum(CASE WHEN job_tasks.cached THEN 0 ELSE tasks.wall_seconds END), 0.0), "
        "coalesce(sum(CASE WHEN job_tasks.cached THEN 0 "
        "ELSE tasks.wall_seconds * tasks.wall_seconds END), 0.0), "
        "max(tasks.finished_at) "
        "FROM tasks CROSS JOIN job_tasks CROSS JOIN jobs "
        "WHERE tasks.seq IN :b_tasks AND job_tasks.task = tasks.seq "
        "AND jobs.seq = job_tasks.job AND jobs.finished_at IS NULL "
        "GROUP BY job_tasks.job, tasks.stage, tasks.cost_group"
    ).bindparams(bindparam("b_tasks", expanding=True)),
)
_ADD_RESULTS = Statement(
    "UPDATE job_totals SET succeeded = succeeded + :b_succeeded, "
    "rejected = rejected + :b_rejected, "
    "failed = failed + :b_failed, cpu_seconds = cpu_seconds + :b_cpu, "
    "wall_count = wall_count + :b_wall_count, wall_sum = wall_sum + :b_wall, "
    "wall_squares = wall_squares + :b_wall_squares, "
    "updated_at = coalesce(:b_updated, updated_at) "
    "WHERE job = :b_job AND stage = :b_stage AND cost_group = :b_group"
)
_REMOVE_RESULTS = Statement(
    "UPDATE job_totals SET succeeded = succeeded - :b_succeeded, "
    "rejected = rejected - :b_rejected, "
    "failed = failed - :b_failed WHERE job = :b_job AND stage = :b_stage AND cost_group = :b_group"
)


def add_results(connection: Connection, tasks: Collection[int]) -> None:
    """Add tasks that have just got their result, or failed for good, to the totals of jobs."""
    for batch in batches(tasks):
        rows = _RESULTS_BY_JOB.rows(connection, {"b_tasks": batch})
        _ADD_RESULTS.run_all(connection, [row._asdict() for row in rows])


def remove_results(connection: Connection, tasks: Collection[int]) -> None:
    """Take tasks that are about to run again out of the totals of results, but keep their cost."""
    for batch in batches(tasks):
        rows = _RESULTS_BY_JOB.rows(connection, {"b_tasks": batch})
        _REMOVE_RESULTS.run_all(connection, [row._asdict() for row in rows])


# ---- Reading -------------------------------------------------------------------------------------


class GroupTotals(NamedTuple):
    """A row of `job_totals`."""

    job: int
    stage: str
    cost_group: str
    total: int
    cached: int
    succeeded: int
    rejected: int
    failed: int
    cpu_seconds: float
    wall_count: int
    wall_sum: float
    wall_squares: float

    @property
    def unfinished(self) -> int:
        """Number of tasks without a result."""
        return self.total - self.succeeded - self.rejected - self.failed


class InFlight(NamedTuple):
    """Number of tasks of a job on lease, or waiting for a retry."""

    job: int
    stage: str
    state: str
    number: int


_TOTALS = RowQuery(
    GroupTotals,
    text(
        f"SELECT {', '.join(GroupTotals._fields)} FROM job_totals WHERE job IN :b_jobs"
    ).bindparams(bindparam("b_jobs", expanding=True)),
)
_IN_FLIGHT_SQL = (
    "SELECT job_tasks.job, tasks.stage, tasks.state, count(*) FROM tasks CROSS JOIN job_tasks "
    "WHERE {is_in_flight} AND job_tasks.task = tasks.seq {is_of_job}"
    "GROUP BY job_tasks.job, tasks.stage, tasks.state"
)
_IN_FLIGHT_STATES = ("tasks.owner IS NOT NULL", "tasks.state = 'soft_failed'")
_IN_FLIGHT = RowQuery(
    InFlight,
    " UNION ALL ".join(
        _IN_FLIGHT_SQL.format(is_in_flight=condition, is_of_job="")
        for condition in _IN_FLIGHT_STATES
    ),
)
# A task in flight is looked up among the tasks of the job by the key of job_tasks.
_IN_FLIGHT_OF_JOB = RowQuery(
    InFlight,
    " UNION ALL ".join(
        _IN_FLIGHT_SQL.format(is_in_flight=condition, is_of_job="AND job_tasks.job = :b_job ")
        for condition in _IN_FLIGHT_STATES
    ),
)


def read_totals(connection: Connection, jobs: Iterable[int]) -> dict[int, list[GroupTotals]]:
    """Return the totals of jobs by stage and cost group."""
    totals: dict[int, list[GroupTotals]] = {}
    for row in _TOTALS.batched_rows(connection, "b_jobs", jobs):
        totals.setdefault(row.job, []).append(row)
    return totals


def count_in_flight(connection: Connection, jobs: Collection[int]) -> list[InFlight]:
    """Return the numbers of tasks in flight of jobs."""
    if len(jobs) == 1:
        return _IN_FLIGHT_OF_JOB.rows(connection, {"b_job": next(iter(jobs))})
    wanted = set(jobs)
    return [row for row in _IN_FLIGHT.rows(connection) if row.job in wanted]


class _StageTotals(NamedTuple):
    stage: str
    is_open: bool
    total: int
    succeeded: int
    rejected: int
    failed: int


class _StateCount(NamedTuple):
    stage: str
    state: str
    number: int


_TOTALS_BY_STAGE = RowQuery(
    _StageTotals,
    "SELECT job_totals.stage, jobs.finished_at IS NULL, sum(job_totals.total), "
    "sum(job_totals.succeeded), sum(job_totals.rejected), sum(job_totals.failed) "
    "FROM job_totals JOIN jobs ON jobs.seq = job_totals.job "
    "GROUP BY job_totals.stage, jobs.finished_at IS NULL",
)
_COUNTS_IN_FLIGHT = RowQuery(
    _StateCount,
    " UNION ALL ".join(
        f"SELECT stage, state, count(*) FROM tasks WHERE {condition} GROUP BY stage, state"
        for condition in _IN_FLIGHT_STATES
    ),
)


def count_tasks(connection: Connection) -> dict[tuple[str, str], int]:
    """Return the numbers of tasks by stage and state, without reading the tasks.

    Tasks with results, and pending ones of open jobs, count once for each of their jobs.
    """
    counts = Counter[tuple[str, str]]()
    for row in _COUNTS_IN_FLIGHT.rows(connection):
        counts[row.stage, row.state] += row.number
    in_flight = Counter[str]()
    for (stage, _), count in counts.items():
        in_flight[stage] += count
    waiting = Counter[str]()
    for totals in _TOTALS_BY_STAGE.rows(connection):
        counts[totals.stage, TaskState.succeeded] += totals.succeeded
        counts[totals.stage, TaskState.rejected] += totals.rejected
        counts[totals.stage, TaskState.failed] += totals.failed
        if totals.is_open:
            unfinished = totals.total - totals.succeeded - totals.rejected - totals.failed
            waiting[totals.stage] += unfinished
    for stage in Stage:
        counts[stage, TaskState.pending] = max(0, waiting[stage] - in_flight[stage])
    return {key: count for key, count in counts.items() if count}


_FAILED = RowQuery(
    _StateCount,
    "SELECT '', 'failed', coalesce(sum(failed), 0) FROM job_totals WHERE job = :b_job",
)


def count_failed(connection: Connection, job: int) -> int:
    """Return the number of tasks of a job that failed for good."""
    row = _FAILED.first(connection, {"b_job": job})
    return 0 if row is None else int(row.number)
