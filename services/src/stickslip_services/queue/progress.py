"""How far jobs are, from the counters that the ledger keeps; no row of `tasks` is read."""

from collections.abc import Collection, Mapping

from sqlalchemy import Connection, Row, select
from stickslip_schemas.responses import Progress, StageProgress
from stickslip_schemas.states import JobState, Stage, TaskState

from stickslip_services.database.tables import job_counts, job_stages, stage_timings
from stickslip_services.queue.eta import StageTimings, StageWork, estimate

_OVER = (TaskState.succeeded, TaskState.rejected, TaskState.failed, TaskState.cancelled)


def read_progress(
    connection: Connection, rows: Collection[Row[tuple[object, ...]]], slots: Mapping[int, int]
) -> dict[int, Progress]:
    """Return the progress of jobs (rows of `jobs`) by `seq`; `slots` says how many tasks of each can run at once."""
    seqs = [row.seq for row in rows]
    counts: dict[tuple[int, str], dict[TaskState, int]] = {}
    for job, stage, state, count in connection.execute(select(job_counts).where(job_counts.c.job.in_(seqs))):
        counts.setdefault((job, stage), {})[TaskState(state)] = count
    stages = {
        (row.job, row.stage): row for row in connection.execute(select(job_stages).where(job_stages.c.job.in_(seqs)))
    }
    earlier = {
        (row.stage, row.kind): StageTimings(row.wall_count, row.wall_sum, row.wall_squares)
        for row in connection.execute(select(stage_timings))
    }
    return {row.seq: _progress(row, counts, stages, earlier, slots[row.seq]) for row in rows}


def rejected_samples(progress: Progress) -> int:
    """Return the number of rejected samples, while a job runs: one for each rejected task of the last stage."""
    rendered = progress.stages.get(Stage.render)
    last = rendered if rendered is not None and rendered.counts else progress.stages.get(Stage.simulate)
    return 0 if last is None else last.counts.get(TaskState.rejected, 0)


def _progress(
    row: Row[tuple[object, ...]],
    counts: dict[tuple[int, str], dict[TaskState, int]],
    stages: dict[tuple[int, str], Row[tuple[object, ...]]],
    earlier: dict[tuple[str, str], StageTimings],
    slots: int,
) -> Progress:
    shown: dict[Stage, StageProgress] = {}
    work: dict[Stage, StageWork] = {}
    for stage in Stage:
        kept = stages.get((row.seq, stage))
        if kept is None:  # not planned yet
            continue
        mine = counts[row.seq, stage]
        shown[stage] = StageProgress(
            counts={state: count for state, count in mine.items() if count},
            cached=kept.cached,
            cpu_seconds=kept.cpu_seconds,
        )
        left = sum(count for state, count in mine.items() if state not in _OVER)
        timings = StageTimings(kept.wall_count, kept.wall_sum, kept.wall_squares)
        work[stage] = StageWork(left, timings if timings.count else earlier.get((stage, row.kind)))
    eta = None
    if row.state in (JobState.queued, JobState.running) and row.builds is not None:
        eta = estimate(work, slots=slots)
    return Progress(
        done=sum(stage.counts.get(state, 0) for stage in shown.values() for state in _OVER),
        total=sum(count for stage in shown.values() for count in stage.counts.values()),
        stages=shown,
        eta=eta,
    )
