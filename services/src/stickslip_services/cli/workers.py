"""Commands for workers, and for the certificates of their builds: measure, register and list."""

from datetime import UTC, datetime
from pathlib import Path

import click
from click.exceptions import Exit
from stickslip_schemas.kinds.rod_hang import ROD_PRESET
from stickslip_schemas.spec.jobs import PresetName

from stickslip_services.cli.common import FILE, asks, json_option, print_json, print_table
from stickslip_services.client.errors import UnreachableError
from stickslip_services.client.http import Client
from stickslip_services.local import making
from stickslip_services.units import duration


@click.command()
@json_option
@asks
def workers(client: Client, as_json: bool) -> None:
    """List the registered workers, newest first."""
    found = client.workers()
    if as_json:
        return print_json(found)
    rows, now = [], datetime.now(UTC)
    for worker in found:
        ago = f"{duration(max(0.0, (now - worker.last_seen_at).total_seconds()))} ago"
        seen = ago if worker.alive else click.style(f"{ago}: not connected", fg="red")
        numbers = str(worker.condition.slots), str(worker.leased)
        rows.append((worker.name, worker.condition.state, *numbers, seen, ", ".join(worker.builds)))
    print_table(("worker", "state", "slots", "tasks", "last seen", "kinds"), rows)
    for worker in found:
        if worker.condition.reason:
            click.echo(f"{worker.name}: {worker.condition.reason}")
    return None


PRESETS = (ROD_PRESET, *(preset.value for preset in PresetName))


@click.command()
@click.option("--preset", type=click.Choice(PRESETS), required=True, help="the preset to certify")
@click.option("--out", type=FILE, help="folder for the certificate (certificates/PRESET)")
@click.option(
    "--quick",
    is_flag=True,
    help="measure a few points only, in seconds; such a certificate does not count",
)
@asks
def certify(client: Client, preset: str, out: Path | None, quick: bool) -> None:
    """Measure a preset on the physical protocols, and register the certificate with the
    coordinator.

    A full certificate of a cloth preset takes about eight minutes of CPU time. It vouches for this
    build and preset only. Writes certificate.json; exits with 1 if the preset does not pass.
    """
    directory = out or Path("certificates") / preset
    certificate = making.measure(preset, directory, quick=quick)
    written = directory / making.DOCUMENT_NAME
    if quick:
        passed = "All" if certificate.passed else "NOT all"
        click.echo(
            f"{passed} of the few points that were measured are within the tolerances: {written}"
        )
        click.echo(
            f"A quick run does not count. To certify the preset: stickslip certify --preset {preset}"
        )
    else:
        click.echo(
            f"preset {preset} {'passed' if certificate.passed else 'did NOT pass'}: {written}"
        )
    client.patience = 1.0
    try:
        _register(client, directory)
    except UnreachableError:
        click.echo(f"no coordinator answers at {client.url}; later: stickslip register {directory}")
    raise Exit(0 if certificate.passed else 1)


@click.command()
@click.argument("directory", metavar="DIR", type=FILE, help="what `stickslip certify` wrote")
@asks
def register(client: Client, directory: Path) -> None:
    """Register a certificate that was measured without a running coordinator."""
    _register(client, directory)


def _register(client: Client, directory: Path) -> None:
    entry = client.register(making.read_certificate(directory))
    click.echo(
        f"certificate {entry.digest} is registered: {client.url}/certificates/{entry.digest}"
    )


@click.command()
@json_option
@asks
def certificates(client: Client, as_json: bool) -> None:
    """List certificates, newest first, and compare their builds with those of the connected
    workers.
    """
    found = list(client.certificates())
    if as_json:
        return print_json(found)
    builds = {own.sim_core for worker in client.workers() for own in worker.builds.values()}
    rows = []
    for entry in found:
        verdict = (
            click.style("passed", fg="green") if entry.passed else click.style("failed", fg="red")
        )
        build = "this" if entry.sim_core in builds else f"another ({entry.sim_core[:12]})"
        made = f"{entry.created_at:%Y-%m-%d %H:%M} UTC"
        rows.append((entry.digest[:16], entry.preset, verdict, build, entry.extent, made))
    return print_table(("certificate", "preset", "verdict", "build", "extent", "made"), rows)
