"""The command that measures the friction of a real cloth in a film."""

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
def film() -> None:
    """Measure the friction of a real cloth in a film of a phone.

    `stickslip film marker OUT.pdf` writes the sheet of markers for a printer, and `stickslip film
    FILM` measures. Passes all arguments on to `stickslip-train film`. It needs no coordinator.
    """
    if find_spec("stickslip_training") is None:
        raise ClientError(
            "`stickslip film` needs the training package: "
            + install_hint("stickslip-training", "film")
        )
    # In a process of its own: torch and OpenCV are heavy, and may be missing.
    process = subprocess.run(
        [
            sys.executable,
            "-m",
            "stickslip_training.cli",
            "film",
            *click.get_current_context().args,
        ],
        check=False,
    )
    raise Exit(process.returncode)
