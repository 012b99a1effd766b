"""Commands for workers, and for the certificates of their builds: measure, register and list."""

from datetime import UTC, datetime
from pathlib import Path

import click
from click.exceptions import Exit
from stickslip_schemas.documents.responses import CertificateEntry, WorkerEntry
from stickslip_schemas.kinds.rod_hang import ROD_PRESET
from stickslip_schemas.spec.jobs import PresetName

from stickslip_services.cli.common import FILE, asks, json_option
from stickslip_services.cli.output import Cell, Styled, print_json, print_table, tell
from stickslip_services.client.answers import printable
from stickslip_services.client.errors import UnreachableError
from stickslip_services.client.http import Client
from stickslip_services.local import making
from stickslip_services.units import duration

PRESETS = (ROD_PRESET, *(preset.value for preset in PresetName))
DIGEST_LETTERS = 16
"""Letters of a certificate's digest that a table shows."""
BUILD_LETTERS = 12
"""Letters of a build that a table shows."""
REGISTER_RETRY_SECONDS = 1.0
"""How long a coordinator is waited for after a measurement [s]: it may well not run."""


@click.command()
@json_option
@asks
def workers(client: Client, as_json: bool) -> None:
    """List the registered workers, newest first."""
    entries = client.workers()
    if as_json:
        print_json(entries)
        return
    rows = [_worker_row(worker) for worker in entries]
    print_table(("worker", "state", "slots", "tasks", "last seen", "kinds"), rows)
    # Reasons are sentences, and would not fit into the table.
    for worker in entries:
        if worker.condition.reason:
            tell(printable(f"{worker.name}: {worker.condition.reason}"))


def _worker_row(worker: WorkerEntry) -> tuple[Cell, ...]:
    # The clocks of two machines may differ by more than a worker is silent.
    silence = max(0.0, (datetime.now(UTC) - worker.last_seen_at).total_seconds())
    last_seen = f"{duration(silence)} ago"
    return (
        worker.name,
        str(worker.condition.state),
        str(worker.condition.slots),
        str(worker.leased),
        last_seen if worker.alive else Styled(f"{last_seen}: not connected", "red"),
        ", ".join(worker.builds),
    )


@click.command()
@click.option(
    "--preset",
    type=click.Choice(PRESETS),
    metavar="PRESET",
    required=True,
    help=f"the preset to certify: {', '.join(PRESETS)}",
)
@click.option("--out", type=FILE, help="folder for the certificate (certificates/PRESET)")
@click.option(
    "--quick",
    is_flag=True,
    help="measure a few points only, in seconds; such a certificate does not count",
)
@asks
def certify(client: Client, preset: str, out: Path | None, quick: bool) -> None:
    """Measure a preset on the physical protocols, and register the certificate.

    A full certificate of a cloth preset takes two to four minutes of CPU time. It vouches for this
    build and preset only. Writes certificate.json; exits with 1 if the preset does not pass.
    """
    directory = out or Path("certificates") / preset
    certificate = making.measure(preset, directory, quick=quick)
    file = directory / making.DOCUMENT_NAME
    if quick:
        passed = "All" if certificate.passed else "NOT all"
        tell(f"{passed} of the few points that were measured are within the tolerances: {file}")
        tell(
            "A quick run does not count. To certify the preset: "
            f"stickslip certify --preset {preset}"
        )
    else:
        tell(f"preset {preset} {'passed' if certificate.passed else 'did NOT pass'}: {file}")
    # The certificate is on the disk and can be registered later.
    client.retry_timeout = REGISTER_RETRY_SECONDS
    try:
        _register(client, directory)
    except UnreachableError:
        tell(f"no coordinator answers at {client.url}; later: stickslip register {directory}")
    raise Exit(0 if certificate.passed else 1)


@click.command()
@click.argument("directory", metavar="DIR", type=FILE, help="what `stickslip certify` wrote")
@asks
def register(client: Client, directory: Path) -> None:
    """Register a certificate that was measured without a running coordinator."""
    _register(client, directory)


def _register(client: Client, directory: Path) -> None:
    entry = client.register(making.read_certificate(directory))
    tell(f"certificate {entry.digest} is registered: {client.url}/certificates/{entry.digest}")


@click.command()
@json_option
@asks
def certificates(client: Client, as_json: bool) -> None:
    """List certificates, newest first, and whether they are of the connected workers' builds."""
    entries = list(client.certificates())
    if as_json:
        print_json(entries)
        return
    # A certificate counts only for the build that it was measured with.
    builds: set[str] = set()
    for worker in client.workers():
        builds.update(build.sim_core for build in worker.builds.values())
    rows = [_certificate_row(entry, entry.sim_core in builds) for entry in entries]
    print_table(("certificate", "preset", "verdict", "build", "extent", "made"), rows)


def _certificate_row(entry: CertificateEntry, is_of_workers: bool) -> tuple[Cell, ...]:
    return (
        entry.digest[:DIGEST_LETTERS],
        entry.preset,
        Styled("passed", "green") if entry.passed else Styled("failed", "red"),
        "this" if is_of_workers else f"another ({entry.sim_core[:BUILD_LETTERS]})",
        entry.extent,
        f"{entry.created_at:%Y-%m-%d %H:%M} UTC",
    )
