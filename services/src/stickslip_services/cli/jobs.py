"""Commands for jobs and their textures: validate, upload, submit, list, watch, pause, prioritise and cancel."""

import json
import os
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table
from stickslip_schemas.base.states import JobState, TaskState
from stickslip_schemas.documents.responses import FileUpload, JobDetail, TextureEntry
from stickslip_schemas.format.layout import bytes_estimate
from stickslip_schemas.plan.costs import Estimate, estimated
from stickslip_schemas.plan.grid import count
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.addresses import DEFAULT_URL
from stickslip_services.cli import wording
from stickslip_services.cli.common import (
    JobArgument,
    JsonOption,
    SpecArgument,
    UrlOption,
    console,
    print_json,
    say,
    table,
)
from stickslip_services.cli.errors import shows_errors
from stickslip_services.cli.specs import check_spec, read_job
from stickslip_services.cli.watch import GOOD, watch
from stickslip_services.client.errors import ClientError, UnreachableError
from stickslip_services.client.http import Client
from stickslip_services.units import duration, size

SHOWN_REJECTS = 50

PRIORITY = "tasks of the job with the highest number come first; jobs of one number share evenly"
PriorityOption = Annotated[int, typer.Option(min=-100, max=100, help=PRIORITY)]


@shows_errors
def validate(file: SpecArgument, url: UrlOption = DEFAULT_URL, as_json: JsonOption = False) -> None:
    """Check a spec, count its samples and tell what they cost; exit with 1 if it would be refused. Works offline."""
    document, files = read_job(file)
    spec = check_spec(document, file)
    try:
        with Client(url) as client:
            _upload(client, spec, files)
            answer = client.validate(document)
    except UnreachableError:
        return _validate_offline(spec, url, as_json=as_json)
    refused = answer.refusal is not None
    if as_json:
        print_json(answer)
        raise typer.Exit(int(refused))
    cached = "unknown" if answer.cached_count is None else f"{answer.cached_count}"
    shown = _counts(answer.spec)
    shown.add_row("tasks cached", f"{cached} of {answer.task_count}")
    if answer.stored_bytes_estimate is not None:
        shown.add_row("size of the files, about", size(answer.stored_bytes_estimate))
    _add_costs(shown, answer.estimate)
    shown.add_row("certificate", answer.certificate or "none")
    console().print(shown)
    if refused:
        say(f"the spec is valid, but a job of it would be refused now: {answer.refusal}")
        raise typer.Exit(1)
    return say(f"the spec is valid. To make the dataset: stickslip submit {file} --watch")


def _validate_offline(spec: JobSpec, url: str, *, as_json: bool) -> None:
    costs = estimated(spec, count(spec), {}, os.cpu_count() or 1)
    if as_json:
        return typer.echo(json.dumps({"estimate": costs.model_dump(mode="json")}, indent=2))
    shown = _counts(spec)
    _add_costs(shown, costs)
    console().print(shown)
    return say(
        f"the spec is valid. No coordinator answers at {url}, so cached tasks and certificates are unknown, and the "
        "wall time is that of all cores of this machine. To start one here: stickslip up"
    )


def _add_costs(shown: Table, costs: Estimate) -> None:
    for stage, interval in costs.stages.items():
        source = "measured by this service" if stage in costs.measured else "by the package's records"
        shown.add_row(f"CPU time, {stage}", f"{wording.interval(interval)}, {source}")
    shown.add_row("CPU time, all", wording.interval(costs.cpu_seconds))
    wall = "unknown: no worker is there" if costs.wall_seconds is None else wording.interval(costs.wall_seconds)
    shown.add_row(f"wall time, {costs.slots} at once", wall)


def _counts(spec: JobSpec) -> Table:
    counts = count(spec)
    splits = ", ".join(f"{split} {number}" for split, number in counts.expected_splits.items())
    shown = Table.grid(padding=(0, 2))
    shown.add_row("samples", f"{counts.samples} ({splits}, about)")
    shown.add_row("simulations", f"{counts.simulations}")
    shown.add_row("renders", f"{counts.renders}")
    shown.add_row("arrays before compression", size(bytes_estimate(spec)))
    shown.add_row("digest of the spec", spec.content_digest)
    return shown


@shows_errors
def submit(
    file: SpecArgument,
    url: UrlOption = DEFAULT_URL,
    then_watch: Annotated[bool, typer.Option("--watch", help="watch the job until it ends")] = False,
    idempotency_key: Annotated[
        str | None, typer.Option(help="a key that you choose; two submissions with the same key make one job")
    ] = None,
    priority: PriorityOption = 0,
) -> None:
    """Submit a job and print its id."""
    document, files = read_job(file)
    with Client(url) as client:
        if files:
            _upload(client, check_spec(document, file), files)
        job = client.submit(document, idempotency_key=idempotency_key, priority=priority)
        typer.echo(job.id)
        if not then_watch:
            say(f"watch it: stickslip watch {job.id}, or in a browser: {client.url}/jobs/{job.id}")
        else:
            raise typer.Exit(0 if watch(client, job.id, console()) in GOOD else 1)


@shows_errors
def jobs(
    url: UrlOption = DEFAULT_URL,
    as_json: JsonOption = False,
    limit: Annotated[int, typer.Option(min=1, help="the most jobs to list")] = 50,
    search: Annotated[str, typer.Option(help="a part of the name, kind, id or dataset")] = "",
    state: Annotated[JobState | None, typer.Option(help="only jobs in this state")] = None,
    project: Annotated[str, typer.Option(help="only jobs of this project")] = "",
) -> None:
    """List jobs, newest first."""
    with Client(url) as client:
        found = list(islice(client.jobs(search=search, state=state, project=project), limit))
    if as_json:
        return print_json(found)
    columns = ("job", "name", "kind", "state", "samples", "rejected", "tasks", "time left", "dataset")
    shown = table(*columns, no_wrap=("job", "dataset"))
    for job in found:
        shown.add_row(
            job.id,
            job.name or "",
            job.kind,
            wording.state(job.state),
            str(job.sample_count),
            str(job.rejected_count),
            wording.done_of(job.progress),
            "" if job.progress.eta is None else duration(job.progress.eta.seconds),
            wording.dataset(job.dataset),
        )
    return console().print(shown)


@shows_errors
def show(job_id: JobArgument, url: UrlOption = DEFAULT_URL, as_json: JsonOption = False) -> None:
    """Show the state and progress of a job, and its rejected samples with reasons."""
    with Client(url) as client:
        job = client.job(job_id)
        if as_json:
            return print_json(job)
        rejects = client.samples(job_id, state=TaskState.rejected) if job.rejected_count else iter(())
        shown = [reject for reject, _ in zip(rejects, range(SHOWN_REJECTS), strict=False)]
    screen = console()
    screen.print(_job_table(job))
    if shown:
        rejected = Table(title=f"rejected samples ({job.rejected_count})", title_justify="left", box=None)
        for column in ("slot", "reason", "message", "parameters"):
            rejected.add_column(column, overflow="fold")
        for reject in shown:
            labels = ", ".join(f"{name}={value}" for name, value in reject.labels.items())
            rejected.add_row(str(reject.slot), str(reject.reason), escape(reject.message), escape(labels))
        screen.print(rejected)
        if job.rejected_count > len(shown):
            screen.print(
                f"... and {job.rejected_count - len(shown)} more: GET /v1/jobs/{job.id}/samples?state=rejected"
            )
    return None


def _job_table(job: JobDetail) -> Table:
    shown = Table.grid(padding=(0, 2))
    shown.add_row("job", f"{job.id}{f' ({job.name})' if job.name else ''}, {job.kind}")
    shown.add_row("state", wording.state(job.state))
    if job.message:
        shown.add_row("", escape(job.message))
    if job.priority:
        shown.add_row("priority", str(job.priority))
    shown.add_row("tasks", escape(wording.stages(job.progress)))
    if planned := wording.planned(job.progress, job.sample_count):
        shown.add_row("", planned)
    if job.state.is_open:
        shown.add_row("time left", wording.eta(job.progress.eta))
    cpu = sum(stage.cpu_seconds for stage in job.progress.stages.values())
    shown.add_row("CPU time", duration(cpu))
    if job.state in GOOD:
        rate = 1 - job.rejected_count / job.sample_count
        shown.add_row("accepted", f"{job.sample_count - job.rejected_count} of {job.sample_count} samples ({rate:.1%})")
    else:
        shown.add_row("samples", f"{job.sample_count}, {job.rejected_count} rejected so far")
    if job.dataset is not None:
        shown.add_row("dataset", wording.dataset(job.dataset))
        shown.add_row("manifest", job.dataset.manifest)
    return shown


@shows_errors
def watch_job(job_id: JobArgument, url: UrlOption = DEFAULT_URL) -> None:
    """Watch a job until it ends; exit with 0 if it succeeded, else 1."""
    with Client(url) as client:
        state = watch(client, job_id, console())
    raise typer.Exit(0 if state in GOOD else 1)


@shows_errors
def cancel(job_id: JobArgument, url: UrlOption = DEFAULT_URL) -> None:
    """Cancel a job. Finished tasks stay cached, and published datasets stay."""
    with Client(url) as client:
        job = client.cancel(job_id)
    console().print(f"{job.id} is {wording.state(job.state)}. To run it again, submit its spec: results are cached")


@shows_errors
def pause(job_id: JobArgument, url: UrlOption = DEFAULT_URL) -> None:
    """Pause a job: no further task is started, and running tasks finish."""
    with Client(url) as client:
        job = client.pause(job_id)
    console().print(f"{job.id} is {wording.state(job.state)}: {job.message}. To go on: stickslip resume {job.id}")


@shows_errors
def resume(job_id: JobArgument, url: UrlOption = DEFAULT_URL) -> None:
    """Resume a paused job."""
    with Client(url) as client:
        job = client.resume(job_id)
    console().print(f"{job.id} is {wording.state(job.state)}. To watch it: stickslip watch {job.id}")


@shows_errors
def prioritise(
    job_id: JobArgument,
    priority: Annotated[int, typer.Argument(min=-100, max=100, help=PRIORITY)],
    url: UrlOption = DEFAULT_URL,
) -> None:
    """Change the priority of a job, from its next task on. Running tasks continue."""
    with Client(url) as client:
        job = client.prioritise(job_id, priority)
    console().print(f"{job.id} has priority {job.priority}")


def _upload(client: Client, spec: JobSpec, files: Mapping[str, bytes]) -> None:
    """Upload the files that a scene names, by digest."""
    for pointer, digest in spec.artifacts.items():
        if digest in files and pointer.startswith("/scene/looks/"):
            client.upload_texture(files[digest])
        elif digest in files:
            client.upload_file(files[digest])


@shows_errors
def upload(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="PNG or JPEG files; files of scenes")],
    url: UrlOption = DEFAULT_URL,
    as_json: JsonOption = False,
) -> None:
    """Upload pictures as textures, and OBJ, NPZ and CSV files of scenes; print the references that specs use."""
    found: list[TextureEntry | FileUpload] = []
    with Client(url) as client:
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
    pictures = [(file, entry) for file, entry in zip(files, found, strict=True) if isinstance(entry, TextureEntry)]
    for number, (file, picture) in enumerate(pictures):
        console().print(("" if number else "textures:\n") + f"  {_name(file)}: {picture.texture}")
    for entry in found:
        if isinstance(entry, FileUpload):
            console().print(f"file: {entry.file}" + (f"  # counts: {list(entry.counts)}" if entry.counts else ""))
    return None


def _name(file: Path) -> str:
    """Return the name of a texture, from the name of its file."""
    word = "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in file.stem.lower())
    return word.strip("-")[:60] or "custom"
