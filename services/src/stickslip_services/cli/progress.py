"""States, progress and times of jobs in words, and the view of a job that runs."""

import json
import sys
from collections.abc import Iterator

import click
from click.exceptions import Exit
from stickslip_schemas.base import JobState, TaskState
from stickslip_schemas.documents import responses
from stickslip_schemas.plan.costs import Interval

from stickslip_services.cli.output import Styled, columns, print_json_line, say, tell
from stickslip_services.client.answers import printable
from stickslip_services.client.events import EVENT_NAMES, Event
from stickslip_services.client.http import Client
from stickslip_services.units import duration

SUCCEEDED = (JobState.succeeded, JobState.succeeded_with_rejects)
INTERRUPTED_STATUS = 130
"""Exit status after Ctrl-C, as shells have it."""
TASK_ID_CHARACTERS = 20
"""Characters of a task's id that a line shows."""

_COLORS = {
    JobState.planning: "yellow",
    JobState.queued: "yellow",
    JobState.cancelling: "yellow",
    JobState.cancelled: "yellow",
    JobState.succeeded: "green",
    JobState.succeeded_with_rejects: "green",
    JobState.running: "cyan",
    JobState.failed: "red",
}
_NAMED_STATES = (
    TaskState.rejected,
    TaskState.soft_failed,
    TaskState.failed,
    TaskState.cancelled,
)
"""States of tasks that the line of a stage names."""


def state_cell(state: JobState) -> Styled:
    """Return the state of a job as a cell of a table."""
    return Styled(str(state), _COLORS.get(state))


def version_name(reference: responses.DatasetRef | None) -> str:
    """Return a dataset version as `stickslip pull` reads it; empty without one."""
    return "" if reference is None else f"{reference.dataset}:v{reference.version}"


def planned_so_far(progress: responses.Progress, sample_count: int) -> str:
    """Return the number of planned samples; empty when all are planned."""
    if progress.planned == sample_count:
        return ""
    return f"{progress.planned:,} of {sample_count:,} samples are planned"


def stage_counts(progress: responses.Progress) -> str:
    """Return a line of counts: `simulate 12/40 (3 cached, 1 rejected), render 0/40`."""
    stages = []
    for stage, counts in progress.stages.items():
        if not counts.total:
            continue
        named = [f"{counts.cached} cached"] if counts.cached else []
        for state in _NAMED_STATES:
            if counts.counts.get(state):
                named.append(f"{counts.counts[state]} {state}")
        details = f" ({', '.join(named)})" if named else ""
        stages.append(f"{stage} {counts.done}/{counts.total}{details}")
    return ", ".join(stages) or "not planned yet"


def time_left(eta: responses.Eta | None) -> str:
    """Return the time that a job still takes, in words."""
    if eta is None:
        return "unknown"
    return interval(Interval(median=eta.seconds, low=eta.low, high=eta.high))


def interval(value: Interval) -> str:
    """Return an interval of times, in words."""
    return f"about {duration(value.median)} ({duration(value.low)} to {duration(value.high)})"


def watch_job(client: Client, job_id: str, *, as_json: bool) -> JobState:
    """Show the events of a job until it ends, and return its final state.

    Of a job that has ended, only the end is shown.
    """
    job = client.job(job_id)
    view = JsonView() if as_json else LineView(client.url, job)
    # The stream of an ended job would replay its whole history.
    if not job.state.is_open:
        for event in _last_events(job):
            view.show(event)
        return job.state
    # The last state event tells how the job ended, also if the stream was lost in between.
    state = job.state
    try:
        for event in client.events(job.id):
            if isinstance(event, responses.JobStateEvent):
                state = event.state
            view.show(event)
    except KeyboardInterrupt:
        say(
            f"\nthe job goes on. To watch it again: stickslip watch {job.id}. To cancel it: "
            f"stickslip cancel {job.id}"
        )
        # Ctrl-C ends the watching, and never the job.
        raise Exit(INTERRUPTED_STATUS) from None
    return state


def _last_events(job: responses.JobDetail) -> Iterator[Event]:
    """Yield the events that tell how a job has ended."""
    if job.dataset is not None:
        yield responses.DatasetPublishedEvent(dataset=job.dataset)
    yield responses.JobStateEvent(state=job.state, reason=job.reason, message=job.message)


class JsonView:
    """Prints one JSON document a line for each event, with its name in the field `event`."""

    def show(self, event: Event) -> None:
        """Print an event."""
        # Through text, because only there pydantic writes null for numbers that are not finite.
        document = json.loads(event.model_dump_json())
        print_json_line({"event": EVENT_NAMES[type(event)], **document})


class LineView:
    """Prints a line for each event; on a terminal, the last line is the progress and changes."""

    def __init__(self, url: str, job: responses.JobDetail) -> None:
        self._url = url
        self._job = job
        self._last_progress = ""
        self._is_terminal = sys.stdout.isatty()

    def show(self, event: Event) -> None:
        """Print an event."""
        match event:
            case responses.JobProgressEvent():
                self._show_progress(event.progress)
            case responses.JobStateEvent():
                state = click.style(str(event.state), fg=_COLORS.get(event.state))
                self._print(f"{self._job.id}: {event.state}{_because(event.message)}", state)
            case responses.TaskStateEvent():
                task = event.task_id[:TASK_ID_CHARACTERS]
                self._print(f"{task}... {event.state}: {event.reason}{_because(event.message)}")
            case responses.DatasetPublishedEvent():
                self._show_dataset(event.dataset)

    def _show_dataset(self, reference: responses.DatasetRef) -> None:
        name = version_name(reference)
        page = f"{self._url}/datasets/{reference.dataset}/v{reference.version}"
        self._print(f"published {name}")
        self._print(f"download it: stickslip pull {name} DIRECTORY --url {self._url}")
        self._print(f"its page: {page}")

    def _show_progress(self, progress: responses.Progress) -> None:
        planned = planned_so_far(progress, self._job.sample_count)
        text = ", ".join(part for part in (planned, stage_counts(progress)) if part)
        if progress.eta is not None:
            text += f"; {time_left(progress.eta)} left"
        # Many events change nothing that a line shows.
        if text == self._last_progress:
            return
        self._last_progress = text
        if self._is_terminal:
            # A longer line would wrap, and could not be overwritten.
            click.echo(f"\r\x1b[K{text[: columns() - 1]}", nl=False)
        else:
            tell(text)

    def _print(self, text: str, styled_state: str = "") -> None:
        """Print a line over the progress; the state in it may have a colour."""
        # The progress stands on the last line and is overwritten.
        if self._is_terminal:
            click.echo("\r\x1b[K", nl=False)
        line = printable(text)
        if styled_state:
            line = line.replace(click.unstyle(styled_state), styled_state, 1)
        tell(line)


def _because(message: str) -> str:
    return f": {message}" if message else ""
