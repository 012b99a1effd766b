"""Progress of jobs, from the counters of the ledger, and from the frames that running simulations report."""

from collections.abc import Collection, Mapping

from sqlalchemy import Connection, Row, select
from stickslip_schemas.base.states import JobState, Stage, TaskState
from stickslip_schemas.documents.responses import Progress, StageProgress

from stickslip_services.database.tables import job_counts, job_groups, job_stages, job_tasks, tasks
from stickslip_services.queue.eta import Cost, Group, StageWork, estimate, timings_of
from stickslip_services.queue.ids import task_key

Frames = Mapping[str, tuple[int, int]]
"""Progress of running simulations by task: (frames done, frames total)."""


def read_progress(
    connection: Connection,
    rows: Collection[Row[tuple[object, ...]]],
    slots: Mapping[int, int],
    *,
    costs: Mapping[Group, Cost],
    frames: Frames,
) -> dict[int, Progress]:
    """Return the progress of jobs (rows of `jobs`) by `seq`; `slots` is the number of tasks that can run at once."""
    seqs = [row.seq for row in rows]
    counts: dict[tuple[int, str], dict[TaskState, int]] = {}
    for job, stage, state, count in connection.execute(select(job_counts).where(job_counts.c.job.in_(seqs))):
        counts.setdefault((job, stage), {})[TaskState(state)] = count
    stages = {
        (row.job, row.stage): row for row in connection.execute(select(job_stages).where(job_stages.c.job.in_(seqs)))
    }
    running = [row.seq for row in rows if row.state in (JobState.queued, JobState.running)]
    groups: dict[tuple[int, str], list[tuple[str, int]]] = {}
    if running:
        for job, stage, group, left in connection.execute(select(job_groups).where(job_groups.c.job.in_(running))):
            groups.setdefault((job, stage), []).append((group, left))
    told = _frames(connection, seqs, frames)

    def progress_of(row: Row[tuple[object, ...]]) -> Progress:
        shown: dict[Stage, StageProgress] = {}
        work: dict[Stage, list[StageWork]] = {}
        for stage in Stage:
            kept = stages.get((row.seq, stage))
            if kept is None:  # not planned yet
                continue
            mine = [each for key, of_group in told.items() if key[:2] == (row.seq, stage) for each in of_group]
            shown[stage] = StageProgress(
                counts={state: count for state, count in counts[row.seq, stage].items() if count},
                cached=kept.cached,
                cpu_seconds=kept.cpu_seconds,
                frames=(sum(done for done, _ in mine), sum(total for _, total in mine)) if mine else None,
            )
            work[stage] = []
            for group, left in groups.get((row.seq, stage), ()):
                finished = sum(done / max(total, 1) for done, total in told.get((row.seq, stage, group), ()))
                work[stage].append(StageWork(left - finished, timings_of(costs, stage, row.kind, group)))
        eta = None
        if row.state in (JobState.queued, JobState.running) and row.builds is not None:  # else the work is not known
            eta = estimate(work, slots=slots.get(row.seq, 0))
        return Progress(
            done=sum(count for stage in shown.values() for state, count in stage.counts.items() if state.is_over),
            total=sum(count for stage in shown.values() for count in stage.counts.values()),
            planned=row.planned,
            stages=shown,
            eta=eta,
        )

    return {row.seq: progress_of(row) for row in rows}


def _frames(
    connection: Connection, seqs: list[int], frames: Frames
) -> dict[tuple[int, str, str], list[tuple[int, int]]]:
    """Return what running simulations report, (frames done, frames total), by job, stage and cost group."""
    found: dict[tuple[int, str, str], list[tuple[int, int]]] = {}
    by_key = {key: frames[name] for name in frames if (key := task_key(name)) is not None}
    if not by_key:
        return found
    rows = connection.execute(
        select(job_tasks.c.job, tasks.c.stage, tasks.c.cost_group, tasks.c.key)
        .join(tasks, tasks.c.seq == job_tasks.c.task)
        .where(tasks.c.key.in_(by_key), tasks.c.state == TaskState.running, job_tasks.c.job.in_(seqs))
    )
    for job, stage, group, key in rows:
        found.setdefault((job, stage, group), []).append(by_key[key])
    return found


def rejected_samples(progress: Progress) -> int:
    """Return the number of rejected samples of a running job: the rejected tasks of its last stage."""
    rendered = progress.stages.get(Stage.render)
    last = rendered if rendered is not None and rendered.counts else progress.stages.get(Stage.simulate)
    return 0 if last is None else last.counts.get(TaskState.rejected, 0)
