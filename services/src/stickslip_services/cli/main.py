"""The commands of `stickslip`."""

import json
import secrets
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn, TransferSpeedColumn
from rich.table import Table
from stickslip_schemas.responses import CertificateEntry, JobDetail
from stickslip_schemas.states import TaskState

from stickslip_services import __version__, certifying, pull, supervisor
from stickslip_services.cli import wording
from stickslip_services.cli.errors import shows_errors
from stickslip_services.cli.specs import read_spec
from stickslip_services.cli.watch import GOOD, watch
from stickslip_services.client import DEFAULT_URL, Client, ClientError, UnreachableError
from stickslip_services.settings import DEFAULT_PORT

app = typer.Typer(
    name="stickslip",
    help="Physically verified synthetic datasets of slender things.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

UrlOption = Annotated[str, typer.Option("--url", envvar="STICKSLIP_URL", help="where the coordinator is")]
JsonOption = Annotated[bool, typer.Option("--json", help="print JSON for programs")]
SpecArgument = Annotated[Path, typer.Argument(metavar="FILE", help="a JobSpec, YAML or JSON")]
JobArgument = Annotated[str, typer.Argument(metavar="JOB", help="id of a job")]

SHOWN_REJECTS = 50


def _console() -> Console:
    """Return a console as wide as the terminal, or wide enough for any table where there is none to fit into."""
    return Console(soft_wrap=True, highlight=False, width=None if sys.stdout.isatty() else 200)


def _print_json(value: BaseModel | list[Any]) -> None:
    if isinstance(value, BaseModel):
        typer.echo(value.model_dump_json(indent=2))
    else:
        typer.echo(json.dumps([item.model_dump(mode="json") for item in value], indent=2))


@app.callback(invoke_without_command=True)
def _main(version: Annotated[bool, typer.Option("--version", help="print the version")] = False) -> None:
    if version:
        typer.echo(f"stickslip {__version__}")
        raise typer.Exit


@app.command()
@shows_errors
def up(
    data: Annotated[Path, typer.Option(help="directory of everything: database, store, logs")] = Path("stickslip-data"),
    port: Annotated[int, typer.Option(min=0, max=65535, help="port to listen on; 0: any free one")] = DEFAULT_PORT,
    host: Annotated[str, typer.Option(help="address to listen on; this version knows loopback only")] = "127.0.0.1",
    slots: Annotated[int | None, typer.Option(min=1, help="tasks at once; as many as there are cores")] = None,
    dispatcher: Annotated[str | None, typer.Option(hidden=True, help="another dispatcher, for tests")] = None,
) -> None:
    """Run a coordinator and a dispatcher with their workers on this machine, until Ctrl-C."""
    console = _console()
    status = supervisor.run(
        supervisor.Plan(data=data, host=host, port=port, slots=slots, dispatcher=dispatcher),
        on_ready=lambda url: console.print(f"stickslip is up at [bold]{url}[/] (data in {escape(str(data))})"),
    )
    raise typer.Exit(status)


@app.command()
@shows_errors
def validate(file: SpecArgument, url: UrlOption = DEFAULT_URL, as_json: JsonOption = False) -> None:
    """Say what a job would be, without submitting it."""
    with Client(url) as client:
        answer = client.validate(read_spec(file))
    if as_json:
        return _print_json(answer)
    cached = "unknown, as no worker has registered yet" if answer.cached_count is None else f"{answer.cached_count}"
    table = Table.grid(padding=(0, 2))
    table.add_row("samples", f"{answer.sample_count}")
    table.add_row("simulations", f"{answer.simulation_count}")
    table.add_row("tasks done already", cached)
    table.add_row("arrays before compression", wording.size(answer.bytes_estimate))
    table.add_row("spec", answer.spec_digest)
    return _console().print(table)


@app.command()
@shows_errors
def submit(
    file: SpecArgument,
    url: UrlOption = DEFAULT_URL,
    then_watch: Annotated[bool, typer.Option("--watch", help="watch the job until it ends")] = False,
    idempotency_key: Annotated[
        str | None, typer.Option(help="a word of yours: the same one twice makes one job")
    ] = None,
) -> None:
    """Submit a job and print its id."""
    with Client(url) as client:
        job = client.submit(read_spec(file), idempotency_key=idempotency_key or secrets.token_hex(16))
        typer.echo(job.id)
        if then_watch:
            raise typer.Exit(0 if watch(client, job.id, _console()) in GOOD else 1)


@app.command()
@shows_errors
def jobs(
    url: UrlOption = DEFAULT_URL,
    as_json: JsonOption = False,
    limit: Annotated[int, typer.Option(min=1, help="the most jobs to list")] = 50,
) -> None:
    """List jobs, newest first."""
    with Client(url) as client:
        found = [job for job, _ in zip(client.jobs(), range(limit), strict=False)]
    if as_json:
        return _print_json(found)
    table = Table(box=None, header_style="bold")
    for column in ("job", "name", "kind", "state", "samples", "rejected", "tasks", "time left", "dataset"):
        table.add_column(column, overflow="fold", no_wrap=column in ("job", "dataset"))
    for job in found:
        table.add_row(
            job.id,
            job.name or "",
            job.kind,
            wording.state(job.state),
            str(job.sample_count),
            str(job.rejected_count),
            wording.done_of(job.progress),
            "" if job.progress.eta is None else wording.duration(job.progress.eta.seconds),
            wording.dataset(job.dataset),
        )
    return _console().print(table)


@app.command()
@shows_errors
def show(job_id: JobArgument, url: UrlOption = DEFAULT_URL, as_json: JsonOption = False) -> None:
    """Show a job: its state, its progress, and which samples were rejected and why."""
    with Client(url) as client:
        job = client.job(job_id)
        if as_json:
            return _print_json(job)
        rejects = client.samples(job_id, state=TaskState.rejected) if job.rejected_count else iter(())
        shown = [reject for reject, _ in zip(rejects, range(SHOWN_REJECTS), strict=False)]
    console = _console()
    console.print(_job_table(job))
    if shown:
        table = Table(title=f"rejected samples ({job.rejected_count})", title_justify="left", box=None)
        for column in ("slot", "reason", "message", "parameters"):
            table.add_column(column, overflow="fold")
        for reject in shown:
            labels = ", ".join(f"{name}={value}" for name, value in reject.labels.items())
            table.add_row(str(reject.slot), str(reject.reason), escape(reject.message), escape(labels))
        console.print(table)
        if job.rejected_count > len(shown):
            console.print(
                f"... and {job.rejected_count - len(shown)} more: GET /v1/jobs/{job.id}/samples?state=rejected"
            )
    return None


def _job_table(job: JobDetail) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_row("job", f"{job.id}{f' ({job.name})' if job.name else ''}, {job.kind}")
    table.add_row("state", wording.state(job.state))
    if job.message:
        table.add_row("", escape(job.message))
    table.add_row("tasks", escape(wording.stages(job.progress)))
    if not job.state.is_terminal:
        table.add_row("time left", wording.eta(job.progress.eta))
    cpu = sum(stage.cpu_seconds for stage in job.progress.stages.values())
    table.add_row("CPU time", wording.duration(cpu))
    if job.state in GOOD:
        rate = 1 - job.rejected_count / job.sample_count
        table.add_row("accepted", f"{job.sample_count - job.rejected_count} of {job.sample_count} samples ({rate:.1%})")
    else:
        table.add_row("samples", f"{job.sample_count}, {job.rejected_count} rejected so far")
    if job.dataset is not None:
        table.add_row("dataset", wording.dataset(job.dataset))
        table.add_row("manifest", job.dataset.manifest)
    return table


@app.command(name="watch")
@shows_errors
def watch_job(job_id: JobArgument, url: UrlOption = DEFAULT_URL) -> None:
    """Watch a job until it ends; exit with 0 if it succeeded, else 1."""
    with Client(url) as client:
        state = watch(client, job_id, _console())
    raise typer.Exit(0 if state in GOOD else 1)


@app.command()
@shows_errors
def cancel(job_id: JobArgument, url: UrlOption = DEFAULT_URL) -> None:
    """Cancel a job. What is finished or published stays."""
    with Client(url) as client:
        job = client.cancel(job_id)
    _console().print(f"{job.id} is {wording.state(job.state)}")


@app.command()
@shows_errors
def datasets(url: UrlOption = DEFAULT_URL, as_json: JsonOption = False) -> None:
    """List datasets and their versions, newest first."""
    with Client(url) as client:
        found = list(client.datasets())
    if as_json:
        return _print_json(found)
    table = Table(box=None, header_style="bold")
    for column in ("dataset", "name", "kind", "samples", "valid", "size", "made"):
        table.add_column(column, overflow="fold", no_wrap=column == "dataset")
    for dataset in found:
        for version in dataset.versions:
            table.add_row(
                f"{dataset.id}:v{version.version}",
                dataset.name or "",
                dataset.kind,
                str(version.sample_count),
                str(version.valid_count),
                wording.size(version.bytes),
                f"{version.created_at:%Y-%m-%d %H:%M} UTC",
            )
    return _console().print(table)


@app.command(name="pull")
@shows_errors
def pull_dataset(
    dataset: Annotated[str, typer.Argument(metavar="DATASET[:vN]", help="without :vN, the newest version")],
    target: Annotated[Path, typer.Argument(metavar="DEST", help="directory to write to")],
    url: UrlOption = DEFAULT_URL,
) -> None:
    """Download a dataset, every file checked; what is there already is not loaded again."""
    console = _console()
    with Client(url) as client:
        name, version = _resolve(client, dataset)
        columns = (BarColumn(bar_width=32), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
            row = bar.add_task("pull", total=None)
            done = pull.pull(
                client,
                name,
                version,
                target,
                on_plan=lambda _files, count: bar.update(row, total=count),
                on_bytes=lambda count: bar.advance(row, count),
            )
    there = done.files - done.downloaded_files
    console.print(
        f"{name}:v{version} is in {escape(str(target))}: {done.downloaded_files} files loaded "
        f"({wording.size(done.downloaded_bytes)}), {there} there already"
    )


def _resolve(client: Client, dataset: str) -> tuple[str, int]:
    name, colon, version = dataset.partition(":v")
    if not colon:
        versions = client.dataset(name).versions
        if not versions:
            raise ClientError(f"dataset {name} has no version yet")
        return name, versions[-1].version
    if not version.isdecimal() or len(version) > 9:
        raise ClientError(f"a version is written DATASET:v1, and this is {dataset!r}")
    return name, int(version)


@app.command()
@shows_errors
def verify(target: Annotated[Path, typer.Argument(metavar="DIR", help="a dataset that was pulled")]) -> None:
    """Check every file of a dataset against its manifest; exit with 1 if anything is wrong."""
    console = _console()
    faults = pull.verify(target)
    if not faults:
        console.print(f"{escape(str(target))}: every file is as the manifest says")
        return
    table = Table(box=None, header_style="bold")
    for column in ("file", "fault", "detail"):
        table.add_column(column, overflow="fold")
    for fault in faults:
        table.add_row(escape(fault.path), fault.fault, escape(fault.detail))
    console.print(table)
    console.print(f"{len(faults)} files are not as they should be", style="red")
    raise typer.Exit(1)


@app.command()
@shows_errors
def certify(
    preset: Annotated[str, typer.Option(help="the preset to certify; rods: the rod solver")],
    out: Annotated[Path | None, typer.Option(help="folder for the certificate (certificates/PRESET)")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="a few points only; certifies nothing")] = False,
    url: UrlOption = DEFAULT_URL,
) -> None:
    """Measure a preset on the physical protocols with this build, and register its certificate where a coordinator is.

    Writes certificate.json and certificate.html; exits with 1 if the preset does not pass.
    """
    console = _console()
    directory = out or Path("certificates") / preset
    certificate = certifying.measure(preset, directory, quick=quick)
    verdict = "passed" if certificate.passed else "did NOT pass"
    console.print(f"preset {escape(preset)} {verdict}: {escape(str(directory / certifying.PAGE_NAME))}")
    try:
        with Client(url, patience=1.0) as client:
            _say_registered(client.register(certifying.read_certificate(directory)), url)
    except UnreachableError:
        console.print(f"no coordinator answers at {url}; later: stickslip register {escape(str(directory))}")
    raise typer.Exit(0 if certificate.passed else 1)


@app.command()
@shows_errors
def register(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="what `stickslip certify` wrote")],
    url: UrlOption = DEFAULT_URL,
) -> None:
    """Register a certificate that was made without a coordinator, or for another one."""
    upload = certifying.read_certificate(directory)
    with Client(url) as client:
        _say_registered(client.register(upload), url)


def _say_registered(entry: CertificateEntry, url: str) -> None:
    _console().print(f"certificate {entry.digest} is registered: {url.rstrip('/')}{entry.page}")


@app.command()
@shows_errors
def certificates(url: UrlOption = DEFAULT_URL, as_json: JsonOption = False) -> None:
    """List certificates, newest first, and which of them vouch for the workers that are there."""
    with Client(url) as client:
        found = list(client.certificates())
        if as_json:
            return _print_json(found)
        builds = {worker.builds.sim_core for worker in client.workers()}
    table = Table(box=None, header_style="bold")
    for column in ("certificate", "preset", "extent", "verdict", "build", "made"):
        table.add_column(column, overflow="fold", no_wrap=column == "certificate")
    for entry in found:
        table.add_row(
            entry.digest[:16],
            entry.preset,
            entry.extent,
            "[green]passed[/]" if entry.passed else "[red]failed[/]",
            "this" if entry.sim_core in builds else f"another ({entry.sim_core[:12]})",
            f"{entry.created_at:%Y-%m-%d %H:%M} UTC",
        )
    return _console().print(table)
