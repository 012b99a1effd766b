"""Invariants of the queue: conditions that hold in the database between any two transactions.

1. A task has an owner exactly while it is `leased` or `running`, and a retry time exactly while it
   is `soft_failed`.
2. A task waits for as many others as it has dependencies without results.
3. `ready_tasks` has a row for each active job that needs a pending task that waits for nothing. A
   job that has ended may have rows while it `leaves_queue`.
4. The totals of each open job say what the rows of its tasks say.
5. A rejected simulation has rejected its renders.
"""

from collections import Counter
from collections.abc import Iterator, Mapping

from sqlalchemy import Connection, case, func, select
from stickslip_schemas.base import JobState, Stage, TaskState
from stickslip_schemas.documents.responses import StageProgress
from stickslip_services.database.tables import (
    dataset_versions,
    job_tasks,
    job_totals,
    jobs,
    ready_tasks,
    samples,
    task_dependencies,
    tasks,
)
from stickslip_services.queue.job_states import has_exclusive_lease, has_unsettled_job
from stickslip_services.queue.progress import read_progress
from stickslip_services.queue.rows import NEEDING_TASKS, ON_LEASE, SCHEDULABLE


def violations(connection: Connection) -> list[str]:
    """Return the violated invariants, in words; an empty list if all hold."""
    return [
        *_task_faults(connection),
        *_dependency_faults(connection),
        *_ready_faults(connection),
        *_total_faults(connection),
        *_progress_faults(connection),
        *_job_faults(connection),
        *_row_faults(connection),
    ]


def unsettled(connection: Connection) -> list[str]:
    """Return the transitions of jobs that a sweep should have made."""
    faults: list[str] = []
    if has_unsettled_job(connection):
        for row in connection.execute(select(jobs.c.seq, jobs.c.state)):
            if row.state == JobState.pausing and not has_exclusive_lease(
                connection, row.seq, SCHEDULABLE
            ):
                faults.append(f"job {row.seq} is pausing and nothing runs for it alone")
            if row.state == JobState.cancelling and not has_exclusive_lease(
                connection, row.seq, NEEDING_TASKS
            ):
                faults.append(f"job {row.seq} is cancelling and nothing runs for it alone")
    for row in connection.execute(select(jobs.c.seq, jobs.c.state)):
        if row.state not in (JobState.queued, JobState.running):
            continue
        states = set(
            connection.scalars(
                select(tasks.c.state)
                .join(job_tasks, job_tasks.c.task == tasks.c.seq)
                .where(job_tasks.c.job == row.seq)
            )
        )
        if row.state == JobState.queued and states & {*ON_LEASE}:
            faults.append(f"job {row.seq} is queued and a task of it is on lease")
        is_ready = select(ready_tasks.c.task).where(ready_tasks.c.job == row.seq).limit(1)
        is_blocked = TaskState.failed in states and not states & {*ON_LEASE, TaskState.soft_failed}
        if is_blocked and connection.scalar(is_ready) is None:
            faults.append(f"job {row.seq} is {row.state} and only quarantined tasks of it are left")
    return faults


def _task_faults(connection: Connection) -> list[str]:
    faults = []
    for row in connection.execute(select(tasks)):
        is_leased = row.state in ON_LEASE
        for column in ("owner", "expires_at", "leased_for"):
            if is_leased != (getattr(row, column) is not None):
                faults.append(f"task {row.seq} is {row.state} and its {column} says otherwise")
        if row.state == TaskState.cancelled:
            faults.append(f"task {row.seq} is cancelled, which is a state of the API only")
        if row.state == TaskState.succeeded and row.output is None:
            faults.append(f"task {row.seq} has succeeded and has no output")
        if (row.state == TaskState.soft_failed) != (row.retry_at is not None):
            faults.append(f"task {row.seq} is {row.state} and its retry says otherwise")
        if is_leased and row.waiting_on:
            faults.append(f"task {row.seq} is {row.state} and waits for {row.waiting_on} others")
        if row.tries > row.attempts:
            faults.append(
                f"task {row.seq} failed {row.tries} times and was started {row.attempts} times"
            )
    return faults


def _dependency_faults(connection: Connection) -> list[str]:
    needed = tasks.alias()
    settled = (TaskState.succeeded, TaskState.rejected)
    unsettled_count = func.sum(case((needed.c.state.in_(settled), 0), else_=1))
    rows = connection.execute(
        select(tasks.c.seq, tasks.c.waiting_on, unsettled_count)
        .join(task_dependencies, task_dependencies.c.task == tasks.c.seq)
        .join(needed, needed.c.seq == task_dependencies.c.depends_on)
        .group_by(tasks.c.seq)
    )
    faults = [
        f"task {seq} waits for {waiting_on} and should for {count} others"
        for seq, waiting_on, count in rows
        if waiting_on != count
    ]
    doomed = connection.scalars(
        select(tasks.c.seq)
        .join(task_dependencies, task_dependencies.c.task == tasks.c.seq)
        .join(needed, needed.c.seq == task_dependencies.c.depends_on)
        .where(
            tasks.c.stage == Stage.render,
            needed.c.state == TaskState.rejected,
            tasks.c.state != TaskState.rejected,
        )
    )
    return faults + [f"render {seq} is not rejected, and its simulation is" for seq in doomed]


def _ready_faults(connection: Connection) -> list[str]:
    """Compare the queue with the tasks."""
    needs_tasks = jobs.c.state.in_(NEEDING_TASKS)
    expected = connection.execute(
        select(job_tasks.c.task, job_tasks.c.job, tasks.c.stage, tasks.c.cost_group)
        .join(tasks, tasks.c.seq == job_tasks.c.task)
        .join(jobs, jobs.c.seq == job_tasks.c.job)
        .where(needs_tasks, tasks.c.state == TaskState.pending, tasks.c.waiting_on == 0)
    )
    queued = connection.execute(
        select(ready_tasks).join(jobs, jobs.c.seq == ready_tasks.c.job).where(needs_tasks)
    )
    missing = {tuple(row) for row in expected}
    surplus: set[tuple[object, ...]] = set()
    for row in queued:
        if tuple(row) in missing:
            missing.remove(tuple(row))
        else:
            surplus.add(tuple(row))
    faults = [f"{row} is ready, and not in the queue" for row in sorted(missing)]
    faults += [f"{row} is in the queue, and not ready" for row in sorted(map(str, surplus))]
    has_ended = jobs.c.finished_at.is_not(None)
    stuck = connection.execute(
        select(ready_tasks)
        .join(jobs, jobs.c.seq == ready_tasks.c.job)
        .where(has_ended, ~jobs.c.leaves_queue)
    )
    faults += [f"{tuple(row)} is in the queue of a job that has left it" for row in stuck]
    leaving_early = connection.scalars(select(jobs.c.seq).where(~has_ended, jobs.c.leaves_queue))
    return faults + [f"job {job} leaves the queue, and has not ended" for job in leaving_early]


def _total_faults(connection: Connection) -> list[str]:
    """Compare the totals of open jobs with the rows of their tasks."""
    is_open = jobs.c.finished_at.is_(None)
    counted: dict[tuple[int, str, str], Counter[str]] = {}
    for job, stage, group, state, cached, count in connection.execute(
        select(
            job_tasks.c.job,
            tasks.c.stage,
            tasks.c.cost_group,
            tasks.c.state,
            job_tasks.c.cached,
            func.count(),
        )
        .join(tasks, tasks.c.seq == job_tasks.c.task)
        .join(jobs, jobs.c.seq == job_tasks.c.job)
        .where(is_open)
        .group_by(
            job_tasks.c.job, tasks.c.stage, tasks.c.cost_group, tasks.c.state, job_tasks.c.cached
        )
    ):
        counts = counted.setdefault((job, stage, group), Counter())
        counts["total"] += count
        counts["cached"] += count * bool(cached)
        if state in (TaskState.succeeded, TaskState.rejected, TaskState.failed):
            counts[state] += count
    faults: list[str] = []
    rows = connection.execute(
        select(job_totals).join(jobs, jobs.c.seq == job_totals.c.job).where(is_open)
    )
    for row in rows:
        counts = counted.pop((row.job, row.stage, row.cost_group), Counter())
        for name in ("total", "cached", "succeeded", "rejected", "failed"):
            if counts[name] != getattr(row, name):
                faults.append(
                    f"job {row.job} has {getattr(row, name)} {name} of {row.stage} "
                    f"{row.cost_group}, and there are {counts[name]}"
                )
    return faults + [f"there are no totals of {key}" for key in counted]


def _progress_faults(connection: Connection) -> list[str]:
    """Compare the shown progress of open jobs with the rows of their tasks."""
    rows = connection.execute(select(jobs).where(jobs.c.finished_at.is_(None))).all()
    faults: list[str] = []
    for row in rows:
        progress = read_progress(connection, [row], {}, {})[row.seq]
        counts = connection.execute(
            select(tasks.c.stage, tasks.c.state, func.count())
            .join(job_tasks, job_tasks.c.task == tasks.c.seq)
            .where(job_tasks.c.job == row.seq)
            .group_by(tasks.c.stage, tasks.c.state)
        )
        expected = {(stage, state): count for stage, state, count in counts}
        actual = dict(_shown_counts(progress.stages))
        if actual != expected:
            faults.append(f"job {row.seq} shows {actual}, and there are {expected}")
    return faults


def _shown_counts(stages: Mapping[Stage, StageProgress]) -> Iterator[tuple[tuple[str, str], int]]:
    for stage, progress in stages.items():
        for state, count in progress.counts.items():
            yield (stage.value, state.value), count


def _job_faults(connection: Connection) -> list[str]:
    faults = []
    good = (JobState.succeeded, JobState.succeeded_with_rejects)
    for row in connection.execute(select(jobs)):
        if (row.state in good) != (row.manifest is not None):
            faults.append(f"job {row.seq} is {row.state} and its dataset says otherwise")
        if JobState(row.state).is_open != (row.finished_at is None):
            faults.append(f"job {row.seq} is {row.state} and its end says otherwise")
    versions = connection.execute(
        select(dataset_versions.c.manifest, dataset_versions.c.valid_count, tasks.c.state).join(
            tasks, tasks.c.seq == dataset_versions.c.publish_task
        )
    )
    for version in versions:
        if version.manifest is None and version.state == TaskState.succeeded:
            faults.append("a version without a manifest has a publish task that has succeeded")
        if version.manifest is not None and not version.valid_count:
            faults.append("a version without a valid sample is published")
    return faults


def _row_faults(connection: Connection) -> list[str]:
    """The bulk tables have no foreign keys: look that both ends are there."""
    faults = []
    for name, column in (
        ("job_tasks", job_tasks.c.task),
        ("ready_tasks", ready_tasks.c.task),
        ("task_dependencies.task", task_dependencies.c.task),
        ("task_dependencies.depends_on", task_dependencies.c.depends_on),
        ("samples.simulate_task", samples.c.simulate_task),
        ("samples.render_task", samples.c.render_task),
    ):
        lost = connection.scalar(
            select(func.count())
            .where(column.is_not(None), column.not_in(select(tasks.c.seq)))
            .select_from(column.table)
        )
        if lost:
            faults.append(f"{lost} rows of {name} point nowhere")
    return faults
