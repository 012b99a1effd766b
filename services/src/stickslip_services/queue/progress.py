"""Progress of jobs: the numbers of tasks by stage and state, their cost, and the time left."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from sqlalchemy import Connection, LargeBinary, bindparam, text
from stickslip_schemas.base import JobState, Stage, TaskState
from stickslip_schemas.documents.responses import Eta, Progress, StageProgress

from stickslip_services.database.statements import RowQuery
from stickslip_services.queue.eta import (
    Cost,
    Group,
    StageTimings,
    StageWork,
    estimate,
    read_costs,
    timings_of,
)
from stickslip_services.queue.ids import task_key
from stickslip_services.queue.totals import GroupTotals, InFlight, count_in_flight, read_totals

Frames = Mapping[str, tuple[int, int]]
"""Progress of running simulations by task: (frames done, frames total)."""


class ShownJob(Protocol):
    """A row of `jobs`."""

    @property
    def seq(self) -> int: ...
    @property
    def kind(self) -> str: ...
    @property
    def state(self) -> str: ...
    @property
    def builds(self) -> str | None: ...
    @property
    def planned(self) -> int: ...


@dataclass(slots=True)
class _RunningFrames:
    """Progress that the running simulations of a job report."""

    done: int = 0
    total: int = 0
    finished: float = 0.0
    """The progress as a number of tasks.

    Each task counts as the fraction of its frames that are done.
    """

    def add(self, done: int, total: int) -> None:
        self.done += done
        self.total += total
        self.finished += done / max(total, 1)


_GroupOfJob = tuple[int, str, str]
"""Job, stage and cost group."""


@dataclass(slots=True)
class _Numbers:
    """The numbers of the shown jobs in the database."""

    totals: Mapping[int, Sequence[GroupTotals]]
    in_flight: Sequence[InFlight]
    frames: Mapping[_GroupOfJob, _RunningFrames]
    costs: Mapping[Group, Cost]
    slots: Mapping[int, int] = field(default_factory=dict)


def read_progress(
    connection: Connection,
    rows: Collection[ShownJob],
    slots: Mapping[int, int],
    frames: Frames,
) -> dict[int, Progress]:
    """Return the progress of jobs by `seq`.

    `slots` is the number of tasks of a job that can run at once. A job without slots has no
    estimate of the time left.
    """
    seqs = [row.seq for row in rows]
    open_jobs = [row.seq for row in rows if JobState(row.state).is_open]
    numbers = _Numbers(
        totals=read_totals(connection, seqs),
        in_flight=count_in_flight(connection, open_jobs) if open_jobs else (),
        frames=_read_frames(connection, seqs, frames),
        costs=read_costs(connection) if slots else {},
        slots=slots,
    )
    return {row.seq: _progress_of(row, numbers) for row in rows}


def _progress_of(row: ShownJob, numbers: _Numbers) -> Progress:
    totals = numbers.totals.get(row.seq, ())
    stages: dict[Stage, StageProgress] = {}
    done = 0
    total = 0
    for stage in Stage:
        groups = [group for group in totals if group.stage == stage]
        if not groups and row.builds is None:  # not planned yet
            continue
        counts = _counts_of(row, stage, groups, numbers.in_flight)
        stages[stage] = StageProgress(
            counts=counts,
            cached=sum(group.cached for group in groups),
            cpu_seconds=sum(group.cpu_seconds for group in groups),
            frames=_frames_of(row, stage, numbers),
        )
        total += sum(counts.values())
        done += stages[stage].done
    return Progress(
        done=done,
        total=total,
        planned=row.planned,
        stages=stages,
        eta=_eta_of(row, totals, numbers),
    )


def _counts_of(
    row: ShownJob, stage: Stage, groups: Sequence[GroupTotals], in_flight: Sequence[InFlight]
) -> dict[TaskState, int]:
    """Return the numbers of tasks of a stage by state, without zeros."""
    counts = Counter[TaskState]()
    waiting = 0
    for group in groups:
        counts[TaskState.succeeded] += group.succeeded
        counts[TaskState.rejected] += group.rejected
        counts[TaskState.failed] += group.failed
        waiting += group.unfinished
    for running in in_flight:
        if running.job == row.seq and running.stage == stage:
            counts[TaskState(running.state)] += running.number
            waiting -= running.number
    # A job that has ended waits for nothing: it does not get the results that are missing.
    is_open = JobState(row.state).is_open
    counts[TaskState.pending if is_open else TaskState.cancelled] += waiting
    return {state: counts[state] for state in TaskState if counts[state]}


def _frames_of(row: ShownJob, stage: Stage, numbers: _Numbers) -> tuple[int, int] | None:
    done = 0
    total = 0
    for (job, of_stage, _), frames in numbers.frames.items():
        if (job, of_stage) == (row.seq, stage):
            done += frames.done
            total += frames.total
    return (done, total) if total else None


def _eta_of(row: ShownJob, totals: Sequence[GroupTotals], numbers: _Numbers) -> Eta | None:
    slots = numbers.slots.get(row.seq, 0)
    if slots == 0:
        return None
    work: dict[Stage, list[StageWork]] = {stage: [] for stage in Stage}
    for group in totals:
        stage = Stage(group.stage)
        running = numbers.frames.get((row.seq, group.stage, group.cost_group))
        finished = 0.0 if running is None else running.finished
        timings = timings_of(numbers.costs, stage, row.kind, group.cost_group)
        work[stage].append(StageWork(group.unfinished - finished, timings))
    return estimate(work, slots=slots)


class _RunningTask(NamedTuple):
    job: int
    stage: str
    cost_group: str
    key: bytes


_RUNNING_TASKS = RowQuery(
    _RunningTask,
    text(
        "SELECT job_tasks.job, tasks.stage, tasks.cost_group, tasks.key "
        "FROM tasks CROSS JOIN job_tasks "
        "WHERE tasks.key IN :b_keys AND tasks.state = 'running' AND job_tasks.task = tasks.seq"
    ).bindparams(bindparam("b_keys", type_=LargeBinary, expanding=True)),
)


def _read_frames(
    connection: Connection, seqs: Collection[int], frames: Frames
) -> dict[_GroupOfJob, _RunningFrames]:
    """Return the progress that running simulations report, by job, stage and cost group."""
    by_key: dict[bytes, tuple[int, int]] = {}
    for name, progress in frames.items():
        key = task_key(name)
        if key is not None:
            by_key[key] = progress
    running: dict[_GroupOfJob, _RunningFrames] = {}
    wanted = set(seqs)
    for row in _RUNNING_TASKS.batched_rows(connection, "b_keys", by_key):
        if row.job in wanted:
            group = running.setdefault((row.job, row.stage, row.cost_group), _RunningFrames())
            group.add(*by_key[row.key])
    return running


def rejected_samples(progress: Progress) -> int:
    """Return the number of rejected samples of a job: the rejected tasks of its last stage."""
    last = progress.stages.get(Stage.render)
    if last is None or not last.counts:
        last = progress.stages.get(Stage.simulate)
    return 0 if last is None else last.counts.get(TaskState.rejected, 0)


def stage_durations(connection: Connection, job: int) -> dict[Stage, StageTimings]:
    """Return the measured durations of the tasks that a job had to run, by stage."""
    sums: dict[Stage, tuple[int, float, float]] = dict.fromkeys(Stage, (0, 0.0, 0.0))
    for row in read_totals(connection, [job]).get(job, ()):
        count, total, squares = sums[Stage(row.stage)]
        sums[Stage(row.stage)] = (
            count + row.wall_count,
            total + row.wall_sum,
            squares + row.wall_squares,
        )
    return {stage: StageTimings(*values) for stage, values in sums.items()}
