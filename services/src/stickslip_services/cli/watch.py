"""Progress of a job: a line that changes on a terminal, plain lines elsewhere."""

import sys

import click
from click.exceptions import Exit
from stickslip_schemas.base.states import JobState
from stickslip_schemas.documents.responses import DatasetPublishedEvent, JobProgressEvent, JobStateEvent, TaskStateEvent
from stickslip_schemas.documents.responses import Progress as JobProgress

from stickslip_services.cli import wording
from stickslip_services.cli.common import room, say
from stickslip_services.client.http import Client

GOOD = (JobState.succeeded, JobState.succeeded_with_rejects)


def watch(client: Client, job_id: str) -> JobState:
    """Show the progress of a job until it ends; return its final state."""
    job = client.job(job_id)
    try:
        return _follow(client, job_id, _Lines(job.sample_count), job.state)
    except KeyboardInterrupt:
        say(f"\nthe job goes on. To watch it again: stickslip watch {job_id}. To cancel it: stickslip cancel {job_id}")
        raise Exit(130) from None


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
                view.line(f"published {click.style(name, bold=True)}")
                view.line(f"download it: stickslip pull {name} DIRECTORY --url {client.url}")
                view.line(f"its page: {client.url}/datasets/{event.dataset.dataset}/v{event.dataset.version}")
    return state


def _because(message: str) -> str:
    return f": {message}" if message else ""


class _Lines:
    """Prints a line for each event; on a terminal, the last one is the progress and changes."""

    def __init__(self, sample_count: int) -> None:
        self._sample_count = sample_count
        self._last = ""
        self._clear = "\r\x1b[K" if sys.stdout.isatty() else ""

    def line(self, text: str) -> None:
        click.echo(f"{self._clear}{text}")

    def progress(self, progress: JobProgress) -> None:
        text = ", ".join(filter(None, [wording.planned(progress, self._sample_count), wording.stages(progress)]))
        if progress.eta is not None:
            text += f"; {wording.eta(progress.eta)} left"
        if text != self._last:
            click.echo(f"{self._clear}{text[: room() - 1]}" if self._clear else text, nl=not self._clear)
        self._last = text
