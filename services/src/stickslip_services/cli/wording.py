"""States, progress and remaining times as text for the command line."""

import click
from stickslip_schemas.base import JobState, TaskState
from stickslip_schemas.documents.responses import DatasetRef, Eta, Progress, StageProgress
from stickslip_schemas.plan.points import Interval

from stickslip_services.units import duration

_COLORS = {
    JobState.planning: "yellow",
    JobState.queued: "yellow",
    JobState.running: "cyan",
    JobState.cancelling: "yellow",
    JobState.cancelled: "yellow",
    JobState.succeeded: "green",
    JobState.succeeded_with_rejects: "green",
    JobState.failed: "red",
}

_NOTED = (TaskState.rejected, TaskState.soft_failed, TaskState.failed, TaskState.cancelled)


def eta(value: Eta | None) -> str:
    if value is None:
        return "unknown"
    return f"about {duration(value.seconds)} ({duration(value.low)} to {duration(value.high)})"


def interval(value: Interval) -> str:
    return f"about {duration(value.median)} ({duration(value.low)} to {duration(value.high)})"


def state(value: JobState) -> str:
    return click.style(str(value), fg=_COLORS.get(value))


def dataset(value: DatasetRef | None) -> str:
    """Return a dataset version as `stickslip pull` reads it."""
    return "" if value is None else f"{value.dataset}:v{value.version}"


def planned(progress: Progress, sample_count: int) -> str:
    """Return the number of planned samples; empty when all are planned."""
    return "" if progress.planned == sample_count else f"{progress.planned:,} of {sample_count:,} samples are planned"


def stages(progress: Progress) -> str:
    """Return a line of counts: `simulate 12/40 (3 cached, 1 rejected), render 0/40`."""
    shown = [
        f"{stage} {counted.done}/{counted.total}" + (f" ({', '.join(found)})" if (found := notes(counted)) else "")
        for stage, counted in progress.stages.items()
        if counted.total
    ]
    return ", ".join(shown) or "not planned yet"


def notes(counted: StageProgress) -> list[str]:
    """Return counts of tasks of a stage that need a word: `3 cached`, `1 rejected`."""
    cached = [f"{counted.cached} cached"] if counted.cached else []
    return cached + [f"{counted.counts[state]} {state}" for state in _NOTED if counted.counts.get(state)]
