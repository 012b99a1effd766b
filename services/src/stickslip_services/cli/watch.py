"""Progress of a job: bars on a terminal, plain lines elsewhere."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn
from stickslip_schemas.base.states import JobState, Stage, TaskState
from stickslip_schemas.documents.responses import DatasetPublishedEvent, JobProgressEvent, JobStateEvent, TaskStateEvent
from stickslip_schemas.documents.responses import Progress as JobProgress

from stickslip_services.cli import wording
from stickslip_services.cli.common import say
from stickslip_services.client.http import Client

GOOD = (JobState.succeeded, JobState.succeeded_with_rejects)


class _Screen(Protocol):
    def line(self, markup: str) -> None: ...
    def progress(self, progress: JobProgress) -> None: ...


def watch(client: Client, job_id: str, console: Console) -> JobState:
    """Show the progress of a job until it ends; return its final state."""
    job = client.job(job_id)
    try:
        return _follow(client, job_id, console, job.state, job.sample_count)
    except KeyboardInterrupt:
        say(f"\nthe job goes on. To watch it again: stickslip watch {job_id}. To cancel it: stickslip cancel {job_id}")
        raise typer.Exit(130) from None


def _follow(client: Client, job_id: str, console: Console, state: JobState, sample_count: int) -> JobState:
    with (_bars if console.is_terminal else _lines)(console, sample_count) as screen:
        for event in client.events(job_id):
            match event:
                case JobProgressEvent():
                    screen.progress(event.progress)
                case JobStateEvent():
                    state = event.state
                    screen.line(f"{job_id}: {wording.state(state)}{_because(event.message)}")
                case TaskStateEvent():
                    screen.line(f"{event.task_id[:20]}... {event.state}: {event.reason}{_because(event.message)}")
                case DatasetPublishedEvent():
                    name = wording.dataset(event.dataset)
                    screen.line(f"published [bold]{name}[/]")
                    screen.line(f"download it: stickslip pull {name} DIRECTORY --url {client.url}")
                    page = f"{client.url}/datasets/{event.dataset.dataset}/v{event.dataset.version}"
                    screen.line(f"its page: {page}")
    return state


def _because(message: str) -> str:
    return f": {escape(message)}" if message else ""


class _Lines:
    """Prints a line for each event."""

    def __init__(self, console: Console, sample_count: int) -> None:
        self._console = console
        self._sample_count = sample_count
        self._last = ""

    def line(self, markup: str) -> None:
        self._console.print(markup, soft_wrap=True, highlight=False)

    def progress(self, progress: JobProgress) -> None:
        text = ", ".join(filter(None, [wording.planned(progress, self._sample_count), wording.stages(progress)]))
        if progress.eta is not None:
            text += f"; {wording.eta(progress.eta)} left"
        if text != self._last:
            self.line(escape(text))
        self._last = text


class _Bars:
    """Shows a progress bar for each stage."""

    def __init__(self, console: Console, bars: Progress, sample_count: int) -> None:
        self._console = console
        self._bars = bars
        self._sample_count = sample_count
        self._plan: TaskID | None = None
        self._ids: dict[Stage, TaskID] = {}

    def line(self, markup: str) -> None:
        self._console.print(markup, soft_wrap=True, highlight=False)

    def progress(self, progress: JobProgress) -> None:
        if self._plan is None and progress.planned < self._sample_count:
            self._plan = self._bars.add_task("plan", total=self._sample_count, extra="samples")
        if self._plan is not None:
            self._bars.update(self._plan, completed=progress.planned)
        for stage, counted in progress.stages.items():
            if not counted.total:
                continue
            if stage not in self._ids:
                self._ids[stage] = self._bars.add_task(stage, total=counted.total, extra="")
            running = counted.counts.get(TaskState.running, 0)
            notes = ([f"{running} running"] if running else []) + wording.notes(counted)
            row = self._ids[stage]
            self._bars.update(row, total=counted.total, completed=counted.done, extra=", ".join(notes))
        if self._ids and progress.eta is not None:  # on the last bar, whose other notes come late
            self._bars.update(max(self._ids.values()), extra=f"{wording.eta(progress.eta)} left")


@contextmanager
def _lines(console: Console, sample_count: int) -> Iterator[_Screen]:
    yield _Lines(console, sample_count)


@contextmanager
def _bars(console: Console, sample_count: int) -> Iterator[_Screen]:
    columns = (
        TextColumn("{task.description:>9}"),
        BarColumn(bar_width=32),
        MofNCompleteColumn(),
        TextColumn("[dim]{task.fields[extra]}"),
    )
    with Progress(*columns, console=console, transient=False) as bars:
        yield _Bars(console, bars, sample_count)
