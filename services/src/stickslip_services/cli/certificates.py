"""Commands for certificates: measure, register and list."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from stickslip_schemas.documents.responses import CertificateEntry
from stickslip_schemas.kinds.rod_hang import ROD_PRESET
from stickslip_schemas.spec.jobs import PresetName

from stickslip_services.addresses import DEFAULT_URL
from stickslip_services.cli.common import JsonOption, UrlOption, console, print_json, table
from stickslip_services.cli.errors import shows_errors
from stickslip_services.client.errors import UnreachableError
from stickslip_services.client.http import Client
from stickslip_services.local import certifying

PRESETS = (ROD_PRESET, *(preset.value for preset in PresetName))


@shows_errors
def certify(
    preset: Annotated[str, typer.Option(help=f"the preset to certify: {', '.join(PRESETS)}")],
    out: Annotated[Path | None, typer.Option(help="folder for the certificate (certificates/PRESET)")] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="measure a few points only, in seconds; such a certificate does not count")
    ] = False,
    url: UrlOption = DEFAULT_URL,
) -> None:
    """Measure a preset on the physical protocols, and register the certificate with the coordinator.

    A full certificate of a cloth preset takes about eight minutes of CPU time. It vouches for this build and preset
    only. Writes certificate.json; exits with 1 if the preset does not pass.
    """
    screen = console()
    directory = out or Path("certificates") / preset
    certificate = certifying.measure(preset, directory, quick=quick)
    written = escape(str(directory / certifying.DOCUMENT_NAME))
    if quick:
        passed = "All" if certificate.passed else "NOT all"
        screen.print(f"{passed} of the few points that were measured are within the tolerances: {written}")
        screen.print(f"A quick run does not count. To certify the preset: stickslip certify --preset {escape(preset)}")
    else:
        screen.print(f"preset {escape(preset)} {'passed' if certificate.passed else 'did NOT pass'}: {written}")
    try:
        with Client(url, patience=1.0) as client:
            _say_registered(client.register(certifying.read_certificate(directory)), url)
    except UnreachableError:
        screen.print(f"no coordinator answers at {url}; later: stickslip register {escape(str(directory))}")
    raise typer.Exit(0 if certificate.passed else 1)


@shows_errors
def register(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="what `stickslip certify` wrote")],
    url: UrlOption = DEFAULT_URL,
) -> None:
    """Register a certificate that was measured without a running coordinator."""
    certificate = certifying.read_certificate(directory)
    with Client(url) as client:
        _say_registered(client.register(certificate), url)


def _say_registered(entry: CertificateEntry, url: str) -> None:
    console().print(f"certificate {entry.digest} is registered: {url.rstrip('/')}/certificates/{entry.digest}")


@shows_errors
def certificates(url: UrlOption = DEFAULT_URL, as_json: JsonOption = False) -> None:
    """List certificates, newest first, and compare their builds with those of the connected workers."""
    with Client(url) as client:
        found = list(client.certificates())
        if as_json:
            return print_json(found)
        builds = {own.sim_core for worker in client.workers() for own in worker.builds.values()}
    shown = table("certificate", "preset", "extent", "verdict", "build", "made", no_wrap=("certificate",))
    for entry in found:
        shown.add_row(
            entry.digest[:16],
            entry.preset,
            entry.extent,
            "[green]passed[/]" if entry.passed else "[red]failed[/]",
            "this" if entry.sim_core in builds else f"another ({entry.sim_core[:12]})",
            f"{entry.created_at:%Y-%m-%d %H:%M} UTC",
        )
    return console().print(shown)
