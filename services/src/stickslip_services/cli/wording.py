"""How the command line says things: durations, sizes, states, progress."""

from stickslip_schemas.base.states import JobState, TaskState
from stickslip_schemas.documents.responses import DatasetRef, Eta, Job, Progress

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

_OVER = (TaskState.succeeded, TaskState.rejected, TaskState.failed)
"""Done; a cancelled task is not."""


def duration(seconds: float) -> str:
    """Return a time span in words: 9 s, 4 min, 2 h 10 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"


def size(count: int) -> str:
    """Return a number of bytes in words."""
    value = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000:
            return f"{value:.0f} {unit}" if unit == "B" or value >= 100 else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} TB"


def eta(value: Eta | None) -> str:
    """Return the time that is left in words."""
    if value is None:
        return "unknown"
    return f"about {duration(value.seconds)} ({duration(value.low)} to {duration(value.high)})"


def state(value: JobState) -> str:
    """Return a state in its colour (rich markup)."""
    return f"[{_COLORS.get(value, 'white')}]{value}[/]"


def dataset(value: DatasetRef | None) -> str:
    """Return a dataset version as `pull` reads it."""
    return "" if value is None else f"{value.dataset}:v{value.version}"


def done_of(progress: Progress) -> str:
    """Return how many tasks are over."""
    return f"{progress.done}/{progress.total}"


def planned(progress: Progress, sample_count: int) -> str:
    """Return how many samples are planned, where it is not all of them; else nothing."""
    return "" if progress.planned == sample_count else f"{progress.planned:,} of {sample_count:,} samples are planned"


def stages(progress: Progress) -> str:
    """Return a line of counts: `simulate 12/40 (3 cached, 1 rejected), render 0/40`."""
    words = []
    for stage, counted in progress.stages.items():
        total = sum(counted.counts.values())
        if not total:
            continue
        over = sum(counted.counts.get(state, 0) for state in _OVER)
        extra = [f"{counted.cached} cached"] if counted.cached else []
        extra += [
            f"{count} {state}"
            for state, count in counted.counts.items()
            if count and state in (TaskState.rejected, TaskState.failed, TaskState.soft_failed, TaskState.cancelled)
        ]
        words.append(f"{stage} {over}/{total}" + (f" ({', '.join(extra)})" if extra else ""))
    return ", ".join(words) or "not planned yet"


def acceptance(job: Job) -> str:
    """Return how many of the samples so far are good."""
    if not job.rejected_count:
        return "no sample was rejected"
    return f"{job.rejected_count} of {job.sample_count} samples rejected"
