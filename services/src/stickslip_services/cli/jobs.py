"""Commands for jobs and their textures: validate, upload, submit, list, watch, pause, prioritise
and cancel.
"""

import json
import os
import sys
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path

import click
from click.exceptions import Exit
from stickslip_schemas.base import JobState, TaskState
from stickslip_schemas.documents import responses
from stickslip_schemas.format.manifest import bytes_estimate
from stickslip_schemas.plan.costs import Counts, Estimate, Interval, count, estimated
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.cli.common import (
    FILE,
    asks,
    job_argument,
    json_option,
    print_fields,
    print_json,
    print_table,
    room,
    say,
    spec_argument,
)
from stickslip_services.cli.specs import check_spec, read_job
from stickslip_services.client.errors import ClientError, UnreachableError
from stickslip_services.client.http import Client
from stickslip_services.units import duration, size

SHOWN_REJECTS = 50
GOOD = (JobState.succeeded, JobState.succeeded_with_rejects)

_COLORS = {
    **dict.fromkeys(
        (JobState.planning, JobState.queued, JobState.cancelling, JobState.cancelled), "yellow"
    ),
    **dict.fromkeys(GOOD, "green"),
    JobState.running: "cyan",
    JobState.failed: "red",
}
_NOTED = (TaskState.rejected, TaskState.soft_failed, TaskState.failed, TaskState.cancelled)

PRIORITY = click.IntRange(-100, 100)
PRIORITY_HELP = (
    "tasks of the job with the highest number come first; jobs of one number share evenly"
)


@click.command()
@spec_argument
@json_option
@asks
def validate(client: Client, file: Path, as_json: bool) -> None:
    """Check a spec, count its samples and tell what they cost; exit with 1 if it would be refused.

    Works offline.
    """
    document, files = read_job(file)
    spec = check_spec(document, file)
    try:
        _upload(client, spec, files)
        answer = client.validate(document)
    except UnreachableError:
        return _validate_offline(spec, client.url, as_json=as_json)
    refused = answer.refusal is not None
    if as_json:
        print_json(answer)
        raise Exit(int(refused))
    cached = "unknown" if answer.cached_count is None else f"{answer.cached_count}"
    fields = [*_counts(answer, spec), ("tasks cached", f"{cached} of {answer.task_count}")]
    if answer.stored_bytes_estimate is not None:
        fields.append(("size of the files, about", size(answer.stored_bytes_estimate)))
    print_fields([*fields, *_costs(answer.estimate), ("certificate", answer.certificate or "none")])
    if refused:
        say(f"the spec is valid, but a job of it would be refused now: {answer.refusal}")
        raise Exit(1)
    return say(f"the spec is valid. To make the dataset: stickslip submit {file} --watch")


def _validate_offline(spec: JobSpec, url: str, *, as_json: bool) -> None:
    counts = count(spec)
    costs = estimated(spec, counts, {}, os.cpu_count() or 1)
    if as_json:
        return click.echo(json.dumps({"estimate": costs.model_dump(mode="json")}, indent=2))
    print_fields([*_counts(counts, spec), *_costs(costs)])
    return say(
        f"the spec is valid. No coordinator answers at {url}, so cached tasks and certificates are unknown, and the "
        "wall time is that of all cores of this machine. To start one here: stickslip up"
    )


def _costs(costs: Estimate) -> Iterator[tuple[str, str]]:
    for stage, interval in costs.stages.items():
        source = (
            "measured by this service" if stage in costs.measured else "by the package's records"
        )
        yield f"CPU time, {stage}", f"{_interval(interval)}, {source}"
    yield "CPU time, all", _interval(costs.cpu_seconds)
    wall = (
        "unknown: no worker is there"
        if costs.wall_seconds is None
        else _interval(costs.wall_seconds)
    )
    yield f"wall time, {costs.slots} at once", wall


def _counts(counts: Counts | responses.Validation, spec: JobSpec) -> Iterator[tuple[str, str]]:
    shares = ", ".join(f"{split} {number}" for split, number in counts.expected_splits.items())
    yield "samples", f"{counts.sample_count} ({shares}, about)"
    yield "simulations", f"{counts.simulation_count}"
    yield "renders", f"{counts.render_count}"
    yield "arrays before compression", size(bytes_estimate(spec))
    yield "digest of the spec", spec.content_digest


@click.command()
@spec_argument
@click.option("--watch", "then_watch", is_flag=True, help="watch the job until it ends")
@click.option(
    "--idempotency-key",
    help="a key that you choose; two submissions with the same key make one job",
)
@click.option("--priority", type=PRIORITY, default=0, help=PRIORITY_HELP)
@asks
def submit(
    client: Client, file: Path, then_watch: bool, idempotency_key: str | None, priority: int
) -> None:
    """Submit a job and print its id."""
    document, files = read_job(file)
    if files:
        _upload(client, check_spec(document, file), files)
    job = client.submit(document, idempotency_key=idempotency_key, priority=priority)
    click.echo(job.id)
    if not then_watch:
        say(f"watch it: stickslip watch {job.id}, or in a browser: {client.url}/jobs/{job.id}")
    else:
        raise Exit(0 if _watched(client, job.id) in GOOD else 1)


@click.command()
@json_option
@click.option("--limit", type=click.IntRange(1), default=50, help="the most jobs to list")
@click.option("--search", default="", help="a part of the name, kind, id or dataset")
@click.option("--state", type=click.Choice(JobState), help="only jobs in this state")
@click.option("--project", default="", help="only jobs of this project")
@asks
def jobs(
    client: Client, as_json: bool, limit: int, search: str, state: JobState | None, project: str
) -> None:
    """List jobs, newest first."""
    found = list(islice(client.jobs(search=search, state=state, project=project), limit))
    if as_json:
        return print_json(found)
    rows = []
    for job in found:
        left = "" if job.progress.eta is None else duration(job.progress.eta.seconds)
        progress = (
            _coloured(job.state),
            f"{job.progress.done}/{job.progress.total}",
            left,
            _version(job.dataset),
        )
        rows.append(
            (
                job.id,
                *progress,
                job.name or "",
                job.kind,
                str(job.sample_count),
                str(job.rejected_count),
            )
        )
    return print_table(
        ("job", "state", "tasks", "time left", "dataset", "name", "kind", "samples", "rejected"),
        rows,
    )


@click.command()
@job_argument
@json_option
@asks
def show(client: Client, job_id: str, as_json: bool) -> None:
    """Show the state and progress of a job, and its rejected samples with reasons."""
    job = client.job(job_id)
    if as_json:
        return print_json(job)
    rejects = client.samples(job_id, state=TaskState.rejected) if job.rejected_count else iter(())
    shown = list(islice(rejects, SHOWN_REJECTS))
    print_fields(_fields(job))
    if shown:
        click.secho(f"rejected samples ({job.rejected_count})", italic=True)
        rows = []
        for reject in shown:
            parameters = ", ".join(f"{name}={value}" for name, value in reject.labels.items())
            rows.append((str(reject.slot), str(reject.reason), parameters, reject.message))
        print_table(("slot", "reason", "parameters", "message"), rows, sentences=True)
        if job.rejected_count > len(shown):
            click.echo(
                f"... and {job.rejected_count - len(shown)} more: GET /v1/jobs/{job.id}/samples?state=rejected"
            )
    return None


def _fields(job: responses.JobDetail) -> Iterator[tuple[str, str]]:
    yield "job", f"{job.id}{f' ({job.name})' if job.name else ''}, {job.kind}"
    yield "state", _coloured(job.state)
    if job.message:
        yield "", job.message
    if job.priority:
        yield "priority", str(job.priority)
    yield "tasks", _stages(job.progress)
    if planned := planned_so_far(job.progress, job.sample_count):
        yield "", planned
    if job.state.is_open:
        yield "time left", _left(job.progress.eta)
    yield "CPU time", duration(sum(stage.cpu_seconds for stage in job.progress.stages.values()))
    if job.state in GOOD:
        rate = 1 - job.rejected_count / job.sample_count
        yield (
            "accepted",
            f"{job.sample_count - job.rejected_count} of {job.sample_count} samples ({rate:.1%})",
        )
    else:
        yield "samples", f"{job.sample_count}, {job.rejected_count} rejected so far"
    if job.dataset is not None:
        yield "dataset", _version(job.dataset)
        yield "manifest", job.dataset.manifest


@click.command()
@job_argument
@asks
def watch(client: Client, job_id: str) -> None:
    """Watch a job until it ends; exit with 0 if it succeeded, else 1."""
    raise Exit(0 if _watched(client, job_id) in GOOD else 1)


def _watched(client: Client, job_id: str) -> JobState:
    """Show the progress of a job until it ends; return its final state."""
    job = client.job(job_id)
    view, state = _Lines(job.sample_count), job.state
    try:
        for event in client.events(job_id):
            match event:
                case responses.JobProgressEvent():
                    view.progress(event.progress)
                case responses.JobStateEvent():
                    state = event.state
                    view.line(f"{job_id}: {_coloured(state)}{_because(event.message)}")
                case responses.TaskStateEvent():
                    view.line(
                        f"{event.task_id[:20]}... {event.state}: {event.reason}{_because(event.message)}"
                    )
                case responses.DatasetPublishedEvent():
                    name = _version(event.dataset)
                    view.line(f"published {click.style(name, bold=True)}")
                    view.line(f"download it: stickslip pull {name} DIRECTORY --url {client.url}")
                    view.line(
                        f"its page: {client.url}/datasets/{event.dataset.dataset}/v{event.dataset.version}"
                    )
    except KeyboardInterrupt:
        say(
            f"\nthe job goes on. To watch it again: stickslip watch {job_id}. To cancel it: stickslip cancel {job_id}"
        )
        raise Exit(130) from None
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

    def progress(self, progress: responses.Progress) -> None:
        text = ", ".join(
            filter(None, [planned_so_far(progress, self._sample_count), _stages(progress)])
        )
        if progress.eta is not None:
            text += f"; {_left(progress.eta)} left"
        if text != self._last:
            click.echo(
                f"{self._clear}{text[: room() - 1]}" if self._clear else text, nl=not self._clear
            )
        self._last = text


@click.command()
@job_argument
@asks
def cancel(client: Client, job_id: str) -> None:
    """Cancel a job. Finished tasks stay cached, and published datasets stay."""
    job = client.cancel(job_id)
    click.echo(
        f"{job.id} is {_coloured(job.state)}. To run it again, submit its spec: results are cached"
    )


@click.command()
@job_argument
@asks
def pause(client: Client, job_id: str) -> None:
    """Pause a job: no further task is started, and running tasks finish."""
    job = client.pause(job_id)
    click.echo(
        f"{job.id} is {_coloured(job.state)}: {job.message}. To go on: stickslip resume {job.id}"
    )


@click.command()
@job_argument
@asks
def resume(client: Client, job_id: str) -> None:
    """Resume a paused job."""
    job = client.resume(job_id)
    click.echo(f"{job.id} is {_coloured(job.state)}. To watch it: stickslip watch {job.id}")


@click.command(context_settings={"ignore_unknown_options": True})  # -1 is a priority
@job_argument
@click.argument("priority", type=PRIORITY, help=PRIORITY_HELP)
@asks
def priority(client: Client, job_id: str, priority: int) -> None:
    """Change the priority of a job, from its next task on. Running tasks continue."""
    job = client.prioritise(job_id, priority)
    click.echo(f"{job.id} has priority {job.priority}")


def _upload(client: Client, spec: JobSpec, files: Mapping[str, bytes]) -> None:
    """Upload the files that a scene names, by digest."""
    for pointer, digest in spec.artifacts.items():
        if digest in files and pointer.startswith("/scene/looks/"):
            client.upload_texture(files[digest])
        elif digest in files:
            client.upload_file(files[digest])


@click.command()
@click.argument(
    "files", type=FILE, nargs=-1, required=True, help="PNG or JPEG files; files of scenes"
)
@json_option
@asks
def upload(client: Client, files: tuple[Path, ...], as_json: bool) -> None:
    """Upload pictures as textures, and OBJ, NPZ and CSV files of scenes.

    Print the references that specs use.
    """
    found: list[responses.TextureEntry | responses.FileUpload] = []
    for file in files:
        try:
            data = file.read_bytes()
        except OSError as error:
            raise ClientError(f"{file} cannot be read: {error.strerror or error}") from error
        is_scene_file = file.suffix.lower() in (".obj", ".npz", ".csv")
        try:
            found.append(client.upload_file(data) if is_scene_file else client.upload_texture(data))
        except ClientError as error:
            raise ClientError(f"{file} was refused: {error}") from error
    if as_json:
        return print_json(found)
    say("In a spec, under any names:")
    pictures = [
        (file, entry)
        for file, entry in zip(files, found, strict=True)
        if isinstance(entry, responses.TextureEntry)
    ]
    for number, (file, picture) in enumerate(pictures):
        click.echo(("" if number else "textures:\n") + f"  {_name(file)}: {picture.texture}")
    for entry in found:
        if isinstance(entry, responses.FileUpload):
            click.echo(
                f"file: {entry.file}"
                + (f"  # counts: {list(entry.counts)}" if entry.counts else "")
            )
    return None


def _name(file: Path) -> str:
    """Return the name of a texture, from the name of its file."""
    word = "".join(
        letter if letter.isascii() and letter.isalnum() else "-" for letter in file.stem.lower()
    )
    return word.strip("-")[:60] or "custom"


def _left(value: responses.Eta | None) -> str:
    if value is None:
        return "unknown"
    return _interval(Interval(median=value.seconds, low=value.low, high=value.high))


def _interval(value: Interval) -> str:
    return f"about {duration(value.median)} ({duration(value.low)} to {duration(value.high)})"


def _coloured(value: JobState) -> str:
    return click.style(str(value), fg=_COLORS.get(value))


def _version(value: responses.DatasetRef | None) -> str:
    """Return a dataset version as `stickslip pull` reads it."""
    return "" if value is None else f"{value.dataset}:v{value.version}"


def planned_so_far(progress: responses.Progress, sample_count: int) -> str:
    """Return the number of planned samples; empty when all are planned."""
    return (
        ""
        if progress.planned == sample_count
        else f"{progress.planned:,} of {sample_count:,} samples are planned"
    )


def _stages(progress: responses.Progress) -> str:
    """Return a line of counts: `simulate 12/40 (3 cached, 1 rejected), render 0/40`."""
    shown = [
        f"{stage} {counted.done}/{counted.total}"
        + (f" ({', '.join(found)})" if (found := _notes(counted)) else "")
        for stage, counted in progress.stages.items()
        if counted.total
    ]
    return ", ".join(shown) or "not planned yet"


def _notes(counted: responses.StageProgress) -> list[str]:
    """Return counts of tasks of a stage that need a word: `3 cached`, `1 rejected`."""
    cached = [f"{counted.cached} cached"] if counted.cached else []
    return cached + [
        f"{counted.counts[state]} {state}" for state in _NOTED if counted.counts.get(state)
    ]
