"""Invariants of the queue: conditions that hold in the database between any two transactions."""

from collections import Counter

from sqlalchemy import Connection, case, func, select
from stickslip_schemas.base import JobState, Stage, TaskState
from stickslip_services.database.tables import (
    dataset_versions,
    job_counts,
    job_groups,
    job_tasks,
    jobs,
    samples,
    task_counts,
    task_dependencies,
    tasks,
)
from stickslip_services.queue.transaction import (
    FINISHED,
    IS_READY,
    LIVE,
    ON_LEASE,
    RUNNABLE,
    has_exclusive_lease,
)


def violations(connection: Connection) -> list[str]:
    """Return the violated invariants, in words; an empty list if all hold."""
    return [
        *_task_faults(connection),
        *_dependency_faults(connection),
        *_counter_faults(connection),
        *_job_faults(connection),
        *_row_faults(connection),
    ]


def _task_faults(connection: Connection) -> list[str]:
    faults = []
    live_tasks = set(
        connection.scalars(
            select(job_tasks.c.task)
            .join(jobs, jobs.c.seq == job_tasks.c.job)
            .where(jobs.c.state.in_(LIVE))
        )
    )
    live_jobs = set(connection.scalars(select(jobs.c.seq).where(jobs.c.state.in_(LIVE))))
    runnable_jobs = set(connection.scalars(select(jobs.c.seq).where(jobs.c.state.in_(RUNNABLE))))
    runnable_tasks = set(
        connection.scalars(select(job_tasks.c.task).where(job_tasks.c.job.in_(runnable_jobs)))
    )
    for row in connection.execute(select(tasks)):
        held = row.state in (TaskState.leased, TaskState.running)
        if held != (row.owner is not None) or held != (row.expires_at is not None):
            faults.append(f"task {row.seq} is {row.state} and its lease says otherwise")
        if row.state in (TaskState.pending, TaskState.soft_failed) and row.seq not in live_tasks:
            faults.append(f"task {row.seq} is {row.state} and no live job needs it")
        if row.state in (TaskState.pending, TaskState.soft_failed) and row.job not in live_jobs:
            faults.append(f"task {row.seq} is {row.state} and charged to a job that is not live")
        if (
            row.state == TaskState.pending
            and row.seq in runnable_tasks
            and row.job not in runnable_jobs
        ):
            faults.append(
                f"task {row.seq} is pending for a job that may run and charged to one that may not"
            )
        if row.state == TaskState.succeeded and row.output is None:
            faults.append(f"task {row.seq} has succeeded and has no output")
        if (row.state == TaskState.soft_failed) != (row.retry_at is not None):
            faults.append(f"task {row.seq} is {row.state} and its retry says otherwise")
        if held and row.waiting_on:
            faults.append(f"task {row.seq} is {row.state} and waits for {row.waiting_on} others")
        if row.tries > row.attempts:
            faults.append(
                f"task {row.seq} failed {row.tries} times and was started {row.attempts} times"
            )
    return faults


def _dependency_faults(connection: Connection) -> list[str]:
    needed = tasks.alias()
    settled = (TaskState.succeeded, TaskState.rejected)
    unsettled = func.sum(case((needed.c.state.in_(settled), 0), else_=1))
    rows = connection.execute(
        select(tasks.c.seq, tasks.c.waiting_on, unsettled)
        .join(task_dependencies, task_dependencies.c.task == tasks.c.seq)
        .join(needed, needed.c.seq == task_dependencies.c.depends_on)
        .group_by(tasks.c.seq)
    )
    faults = [
        f"task {seq} waits for {said} and should for {is_} others"
        for seq, said, is_ in rows
        if said != is_
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


def _counter_faults(connection: Connection) -> list[str]:
    faults = []
    rows = connection.execute(select(task_counts.c.stage, task_counts.c.state, task_counts.c.count))
    counted = {(stage, state): count for stage, state, count in rows if count}
    rows = connection.execute(
        select(tasks.c.stage, tasks.c.state, func.count()).group_by(tasks.c.stage, tasks.c.state)
    )
    there = {(stage, state): count for stage, state, count in rows}
    if counted != there:
        faults.append(f"task_counts says {counted}, and there are {there}")
    open_jobs = list(
        connection.scalars(
            select(jobs.c.seq).where(
                jobs.c.state.in_([state for state in JobState if state.is_open])
            )
        )
    )
    by_job: dict[int, Counter[tuple[str, str]]] = {job: Counter() for job in open_jobs}
    for job, stage, state, count in connection.execute(
        select(job_tasks.c.job, tasks.c.stage, tasks.c.state, func.count())
        .join(tasks, tasks.c.seq == job_tasks.c.task)
        .where(job_tasks.c.job.in_(open_jobs))
        .group_by(job_tasks.c.job, tasks.c.stage, tasks.c.state)
    ):
        by_job[job][stage, state] = count
    columns = (job_counts.c.job, job_counts.c.stage, job_counts.c.state, job_counts.c.count)
    for job, stage, state, count in connection.execute(
        select(*columns).where(job_counts.c.job.in_(open_jobs))
    ):
        if by_job[job][stage, state] != count:
            faults.append(
                f"job {job} counts {count} {stage} {state}, and there are "
                f"{by_job[job][stage, state]}"
            )
    grouped = connection.execute(
        select(job_tasks.c.job, tasks.c.stage, tasks.c.cost_group, func.count())
        .join(tasks, tasks.c.seq == job_tasks.c.task)
        .where(job_tasks.c.job.in_(open_jobs), tasks.c.state.not_in(FINISHED))
        .group_by(job_tasks.c.job, tasks.c.stage, tasks.c.cost_group)
    )
    there_left = {(job, stage, group): count for job, stage, group, count in grouped}
    said = connection.execute(select(job_groups).where(job_groups.c.job.in_(open_jobs)))
    said_left = {(job, stage, group): count for job, stage, group, count in said if count}
    if said_left != there_left:
        faults.append(f"job_groups says {said_left} are left, and there are {there_left}")
    return faults


def _job_faults(connection: Connection) -> list[str]:
    faults = []
    good = (JobState.succeeded, JobState.succeeded_with_rejects)
    for row in connection.execute(select(jobs)):
        if (row.state in good) != (row.manifest is not None):
            faults.append(f"job {row.seq} is {row.state} and its dataset says otherwise")
        if JobState(row.state).is_open != (row.finished_at is None):
            faults.append(f"job {row.seq} is {row.state} and its end says otherwise")
        own = (
            select(tasks.c.state)
            .join(job_tasks, job_tasks.c.task == tasks.c.seq)
            .where(job_tasks.c.job == row.seq)
        )
        there = set(connection.scalars(own))
        if row.state == JobState.queued and there & {*ON_LEASE}:
            faults.append(f"job {row.seq} is queued and a task of it is on lease")
        if row.state == JobState.pausing and not has_exclusive_lease(connection, row.seq, RUNNABLE):
            faults.append(f"job {row.seq} is pausing and nothing runs for it alone")
        if (
            row.state == JobState.cancelling
            and row.given_up is None
            and not has_exclusive_lease(connection, row.seq, LIVE)
        ):
            faults.append(f"job {row.seq} is cancelling and nothing runs for it alone")
        is_blocked = TaskState.failed in there and not there & {*ON_LEASE, TaskState.soft_failed}
        is_blocked &= connection.execute(own.where(IS_READY).limit(1)).first() is None
        if row.state in (JobState.queued, JobState.running) and is_blocked:
            faults.append(f"job {row.seq} is {row.state} and only quarantined tasks of it are left")
    for row in connection.execute(
        select(dataset_versions.c.manifest, tasks.c.state).join(
            tasks, tasks.c.seq == dataset_versions.c.publish_task
        )
    ):
        if row.manifest is None and row.state == TaskState.succeeded:
            faults.append(
                f"a version with the manifest {row.manifest} has a publish task that is {row.state}"
            )
    return faults


def _row_faults(connection: Connection) -> list[str]:
    """The bulk tables have no foreign keys: look that both ends are there."""
    faults = []
    for name, column in (
        ("job_tasks", job_tasks.c.task),
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
