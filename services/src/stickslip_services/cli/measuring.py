"""The command that measures a simulator."""

import subprocess
import sys
from importlib.util import find_spec

import click
from click.exceptions import Exit
from stickslip_schemas.installation import install_hint

from stickslip_services.cli.common import shows_errors
from stickslip_services.client.errors import ClientError


@click.command(
    context_settings={
        "allow_extra_args": True,
        "ignore_unknown_options": True,
        "help_option_names": [],
    }
)
@shows_errors
def measure() -> None:
    """Measure the friction and bending of any simulator.

    Passes all arguments on to `stickslip-measure`. It needs no coordinator.
    """
    if find_spec("stickslip_measure") is None:
        raise ClientError(
            "`stickslip measure` needs the measuring package: "
            + install_hint("stickslip-measure", "page")
        )
    # In a process of its own: NumPy and the core are heavy, and may be missing.
    process = subprocess.run(
        [sys.executable, "-m", "stickslip_measure", *click.get_current_context().args],
        check=False,
    )
    raise Exit(process.returncode)
