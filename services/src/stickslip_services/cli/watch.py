"""Progress of a job: bars on a terminal, plain lines elsewhere."""

from contextlib import nullcontext

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn
from stickslip_schemas.base.states import JobState, TaskState
from stickslip_schemas.documents.responses import DatasetPublishedEvent, JobProgressEvent, JobStateEvent, TaskStateEvent
from stickslip_schemas.documents.responses import Progress as JobProgress

from stickslip_services.cli import wording
from stickslip_services.cli.common import say
from stickslip_services.client.http import Client

GOOD = (JobState.succeeded, JobState.succeeded_with_rejects)


def watch(client: Client, job_id: str, console: Console) -> JobState:
    """Show the progress of a job until it ends; return its final state."""
    job = client.job(job_id)
    columns = (
        TextColumn("{task.description:>9}"),
        BarColumn(bar_width=32),
        MofNCompleteColumn(),
        TextColumn("[dim]{task.fields[extra]}"),
    )
    bars = Progress(*columns, console=console, transient=False) if console.is_terminal else None
    view = _Lines(console, job.sample_count) if bars is None else _Bars(console, job.sample_count, bars)
    try:
        with bars or nullcontext():
            return _follow(client, job_id, view, job.state)
    except KeyboardInterrupt:
        say(f"\nthe job goes on. To watch it again: stickslip watch {job_id}. To cancel it: stickslip cancel {job_id}")
        raise typer.Exit(130) from None


def _follow(client: Client, job_id: str, view: "_Lines", state: JobState) -> JobState:
    for event in client.events(job_id):
        match event:
            case JobProgressEvent():
                view.progress(event.progress)
            case JobStateEvent():
                state = event.state
                view.line(f"{job_id}: {wording.state(state)}{_because(event.message)}")
            case TaskStateEvent():
                view.line(f"{event.task_id[:20]}... {event.state}: {event.reason}{_because(event.message)}")
            case DatasetPublishedEvent():
                name = wording.dataset(event.dataset)
                view.line(f"published [bold]{name}[/]")
                view.line(f"download it: stickslip pull {name} DIRECTORY --url {client.url}")
                view.line(f"its page: {client.url}/datasets/{event.dataset.dataset}/v{event.dataset.version}")
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


class _Bars(_Lines):
    """Shows a progress bar for planning and for each stage, and prints lines above them."""

    def __init__(self, console: Console, sample_count: int, bars: Progress) -> None:
        super().__init__(console, sample_count)
        self._bars = bars
        self._rows: dict[str, TaskID] = {}

    def progress(self, progress: JobProgress) -> None:
        if "plan" in self._rows or progress.planned < self._sample_count:
            self._show("plan", progress.planned, self._sample_count, "samples")
        for stage, counted in progress.stages.items():
            if counted.total:
                running = counted.counts.get(TaskState.running, 0)
                notes = ([f"{running} running"] if running else []) + wording.notes(counted)
                self._show(stage, counted.done, counted.total, ", ".join(notes))
        if self._rows.keys() - {"plan"} and progress.eta is not None:  # on the last bar, whose other notes come late
            self._bars.update(max(self._rows.values()), extra=f"{wording.eta(progress.eta)} left")

    def _show(self, name: str, done: int, total: int, extra: str) -> None:
        if name not in self._rows:
            self._rows[name] = self._bars.add_task(name, total=total, extra=extra)
        self._bars.update(self._rows[name], total=total, completed=done, extra=extra)
