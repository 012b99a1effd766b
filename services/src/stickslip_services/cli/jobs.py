"""Commands for jobs: validate, upload, submit, list, watch, pause, prioritise and cancel."""

import os
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path

import click
from click.exceptions import Exit
from stickslip_schemas.base import JobState, TaskState
from stickslip_schemas.documents import responses
from stickslip_schemas.format.manifest import bytes_estimate
from stickslip_schemas.plan.costs import Counts, Estimate, count, estimate_cost
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.cli.common import FILE, asks, job_argument, json_option, spec_argument
from stickslip_services.cli.documents import check_spec, read_job
from stickslip_services.cli.output import Cell, print_fields, print_json, print_table, say, tell
from stickslip_services.cli.progress import (
    SUCCEEDED,
    interval,
    planned_so_far,
    stage_counts,
    state_cell,
    time_left,
    version_name,
    watch_job,
)
from stickslip_services.client.answers import printable
from stickslip_services.client.errors import ClientError, UnreachableError
from stickslip_services.client.http import Client
from stickslip_services.units import duration, size

LISTED_REJECTS = 50
"""Most rejected samples that `show` lists."""
TEXTURE_NAME_LETTERS = 60
"""Most letters of the name of a texture in a spec."""
SCENE_FILE_SUFFIXES = (".obj", ".npz", ".csv")

PRIORITY = click.IntRange(-100, 100)
PRIORITY_HELP = (
    "tasks of the job with the highest number come first; jobs of one number share evenly"
)


@click.command()
@spec_argument
@json_option
@asks
def validate(client: Client, file: Path, as_json: bool) -> None:
    """Check a spec, count its samples and tell what they cost.

    Exit with 1 if a job of it would be refused. Works offline.
    """
    # The file is checked here first, so that wrong files are found without a coordinator.
    document, files = read_job(file)
    spec = check_spec(document, file)
    try:
        _upload(client, spec, files)
        answer = client.validate(document)
    except UnreachableError:
        _validate_offline(spec, client.url, as_json=as_json)
        return
    # A valid spec can still be refused: without a worker or a certificate, for example.
    is_refused = answer.refusal is not None
    if as_json:
        print_json(answer)
        raise Exit(int(is_refused))
    print_fields(_validation_fields(answer, spec))
    if is_refused:
        refusal = printable(answer.refusal or "")
        say(f"the spec is valid, but a job of it would be refused now: {refusal}")
        raise Exit(1)
    say(f"the spec is valid. To make the dataset: stickslip submit {file} --watch")


def _validation_fields(answer: responses.Validation, spec: JobSpec) -> Iterator[tuple[str, str]]:
    yield from _counts(answer, spec)
    cached = "unknown" if answer.cached_count is None else str(answer.cached_count)
    yield "tasks cached", f"{cached} of {answer.task_count}"
    if answer.stored_bytes_estimate is not None:
        yield "size of the files, about", size(answer.stored_bytes_estimate)
    yield from _costs(answer.estimate)
    yield "certificate", answer.certificate or "none"


def _validate_offline(spec: JobSpec, url: str, *, as_json: bool) -> None:
    counts = count(spec)
    costs = estimate_cost(spec, counts, {}, os.cpu_count() or 1)
    if as_json:
        print_json({"estimate": costs.model_dump(mode="json")})
        return
    print_fields([*_counts(counts, spec), *_costs(costs)])
    say(
        f"the spec is valid. No coordinator answers at {url}, so cached tasks and certificates are "
        "unknown, and the wall time is that of all cores of this machine. To start one here: "
        "stickslip up"
    )


def _costs(costs: Estimate) -> Iterator[tuple[str, str]]:
    for stage, seconds in costs.stages.items():
        # Rods without pictures have no render, for example.
        if seconds.high == 0.0:
            continue
        is_measured = stage in costs.measured
        source = "measured by this service" if is_measured else "by the package's records"
        yield f"CPU time, {stage}", f"{interval(seconds)}, {source}"
    yield "CPU time, all", interval(costs.cpu_seconds)
    if costs.wall_seconds is None:
        yield f"wall time, {costs.slots} at once", "unknown: no worker is there"
    else:
        yield f"wall time, {costs.slots} at once", interval(costs.wall_seconds)


def _counts(counts: Counts | responses.Validation, spec: JobSpec) -> Iterator[tuple[str, str]]:
    splits = ", ".join(f"{split} {number}" for split, number in counts.expected_splits.items())
    yield "samples", f"{counts.sample_count} ({splits}, about)"
    yield "simulations", str(counts.simulation_count)
    yield "renders", str(counts.render_count)
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
    # The coordinator must have the files of a scene before it accepts the job.
    if files:
        _upload(client, check_spec(document, file), files)
    job = client.submit(document, idempotency_key=idempotency_key, priority=priority)
    # Only the id goes to standard output: `job=$(stickslip submit SPEC.yaml)`.
    click.echo(printable(job.id))
    if then_watch:
        state = watch_job(client, job.id, as_json=False)
        raise Exit(_exit_status(state))
    say(f"watch it: stickslip watch {job.id}, or in a browser: {client.url}/jobs/{job.id}")


def _exit_status(state: JobState) -> int:
    return 0 if state in SUCCEEDED else 1


@click.command()
@json_option
@click.option("--limit", type=click.IntRange(1), default=50, help="the most jobs to list")
@click.option("--search", default="", help="a part of the name, kind, id or dataset")
@click.option(
    "--state",
    type=click.Choice(JobState),
    metavar="STATE",
    help=f"only jobs in this state: {', '.join(JobState)}",
)
@click.option("--project", default="", help="only jobs of this project")
@asks
def jobs(
    client: Client, as_json: bool, limit: int, search: str, state: JobState | None, project: str
) -> None:
    """List jobs, newest first."""
    listed = list(islice(client.jobs(search=search, state=state, project=project), limit))
    if as_json:
        print_json(listed)
        return
    heads = ("job", "state", "tasks", "time left", "dataset", "name", "kind", "samples", "rejected")
    print_table(heads, [_job_row(job) for job in listed])


def _job_row(job: responses.Job) -> tuple[Cell, ...]:
    eta = job.progress.eta
    return (
        job.id,
        state_cell(job.state),
        f"{job.progress.done}/{job.progress.total}",
        "" if eta is None else duration(eta.seconds),
        version_name(job.dataset),
        job.name or "",
        job.kind,
        str(job.sample_count),
        str(job.rejected_count),
    )


@click.command()
@job_argument
@json_option
@asks
def show(client: Client, job_id: str, as_json: bool) -> None:
    """Show the state and progress of a job, and its rejected samples with reasons."""
    job = client.job(job_id)
    if as_json:
        print_json(job)
        return
    print_fields(_job_fields(job))
    if job.rejected_count:
        _print_rejects(client, job)


def _print_rejects(client: Client, job: responses.JobDetail) -> None:
    # A job may have a million rejected samples; the first ones show what is wrong.
    rejects = list(islice(client.samples(job.id, state=TaskState.rejected), LISTED_REJECTS))
    if not rejects:
        return
    click.secho(f"rejected samples ({job.rejected_count})", italic=True)
    rows = []
    for reject in rejects:
        parameters = ", ".join(f"{name}={value}" for name, value in reject.labels.items())
        rows.append((str(reject.slot), str(reject.reason), parameters, reject.message))
    print_table(("slot", "reason", "parameters", "message"), rows, sentences=True)
    rest = job.rejected_count - len(rejects)
    if rest > 0:
        tell(f"... and {rest} more: GET /v1/jobs/{job.id}/samples?state=rejected")


def _job_fields(job: responses.JobDetail) -> Iterator[tuple[str, Cell]]:
    name = f" ({job.name})" if job.name else ""
    yield "job", f"{job.id}{name}, {job.kind}"
    yield "state", state_cell(job.state)
    # The message explains the state, so it stands below it.
    if job.message:
        yield "", job.message
    if job.priority:
        yield "priority", str(job.priority)
    yield "tasks", stage_counts(job.progress)
    planned = planned_so_far(job.progress, job.sample_count)
    if planned:
        yield "", planned
    # A job that has ended takes no more time.
    if job.state.is_open:
        yield "time left", time_left(job.progress.eta)
    yield "CPU time", duration(sum(stage.cpu_seconds for stage in job.progress.stages.values()))
    if job.state in SUCCEEDED:
        accepted = job.sample_count - job.rejected_count
        # Rounded down: 100 % means that no sample was rejected.
        permille = 1000 * accepted // job.sample_count
        yield "accepted", f"{accepted} of {job.sample_count} samples ({permille / 10:.1f}%)"
    else:
        yield "samples", f"{job.sample_count}, {job.rejected_count} rejected so far"
    if job.dataset is not None:
        yield "dataset", version_name(job.dataset)
        yield "manifest", job.dataset.manifest


@click.command()
@job_argument
@click.option("--json", "as_json", is_flag=True, help="print one JSON document for each event")
@asks
def watch(client: Client, job_id: str, as_json: bool) -> None:
    """Watch a job until it ends; exit with 0 if it succeeded, else 1.

    Of a job that has ended, only the end is shown.
    """
    raise Exit(_exit_status(watch_job(client, job_id, as_json=as_json)))


@click.command()
@job_argument
@asks
def cancel(client: Client, job_id: str) -> None:
    """Cancel a job. Finished tasks stay cached, and published datasets stay."""
    job = client.cancel(job_id)
    tell(f"{job.id} is {job.state}. To run it again, submit its spec: results are cached")


@click.command()
@job_argument
@asks
def pause(client: Client, job_id: str) -> None:
    """Pause a job: no further task is started, and running tasks finish."""
    job = client.pause(job_id)
    message = printable(job.message)
    tell(f"{job.id} is {job.state}: {message}. To go on: stickslip resume {job.id}")


@click.command()
@job_argument
@asks
def resume(client: Client, job_id: str) -> None:
    """Resume a paused job."""
    job = client.resume(job_id)
    tell(f"{job.id} is {job.state}. To watch it: stickslip watch {job.id}")


@click.command(context_settings={"ignore_unknown_options": True})  # -1 is a priority
@job_argument
@click.argument("priority", type=PRIORITY, help=PRIORITY_HELP)
@asks
def priority(client: Client, job_id: str, priority: int) -> None:
    """Change the priority of a job, from its next task on. Running tasks continue."""
    job = client.prioritise(job_id, priority)
    tell(f"{job.id} has priority {job.priority}")


def _upload(client: Client, spec: JobSpec, files: Mapping[str, bytes]) -> None:
    """Upload the files that a scene names, by digest."""
    for pointer, digest in spec.artifacts.items():
        # Files of built-in scenes, and files that were uploaded before, are not at hand.
        if digest not in files:
            continue
        # Pictures of looks are checked as textures, all others as files of scenes.
        if pointer.startswith("/scene/looks/"):
            client.upload_texture(files[digest])
        else:
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
    entries = [_upload_file(client, file) for file in files]
    if as_json:
        print_json(entries)
        return
    say("In a spec, under any names:")
    # Textures are named together in a spec, files each in its place.
    textures = []
    references = []
    for file, entry in zip(files, entries, strict=True):
        if isinstance(entry, responses.TextureEntry):
            textures.append(f"  {_texture_name(file)}: {entry.texture}")
        else:
            counts = f"  # counts: {list(entry.counts)}" if entry.counts else ""
            references.append(f"file: {entry.file}{counts}")
    if textures:
        click.echo("textures:")
    for line in (*textures, *references):
        click.echo(line)


def _upload_file(client: Client, file: Path) -> responses.TextureEntry | responses.FileUpload:
    try:
        data = file.read_bytes()
    except OSError as error:
        raise ClientError(f"{file} cannot be read: {error.strerror or error}") from error
    try:
        if file.suffix.lower() in SCENE_FILE_SUFFIXES:
            return client.upload_file(data)
        return client.upload_texture(data)
    # Nobody has looked at the file.
    except UnreachableError:
        raise
    except ClientError as error:
        raise ClientError(f"{file} was refused: {error}") from error


def _texture_name(file: Path) -> str:
    """Return the name of a texture, from the name of its file."""
    letters = [
        letter if letter.isascii() and letter.isalnum() else "-" for letter in file.stem.lower()
    ]
    return "".join(letters).strip("-")[:TEXTURE_NAME_LETTERS] or "custom"
