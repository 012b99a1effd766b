"""The command that measures the friction of a real cloth in a film."""

import click

from stickslip_services.cli.common import shows_errors
from stickslip_services.cli.passed_on import PASSES_ARGUMENTS, Program, run_program

_PROGRAM = Program(
    command="film",
    package="training",
    distribution="stickslip-training",
    extra="film",
    module="stickslip_training.cli",
    words=("film",),
)


@click.command(context_settings=PASSES_ARGUMENTS)
@shows_errors
def film() -> None:
    """Measure the friction of a real cloth in a film of a phone.

    `stickslip film marker OUT.pdf` writes the sheet of markers for a printer, and `stickslip film
    FILM` measures. Passes all arguments on to `stickslip-train film`. It needs no coordinator.
    """
    run_program(_PROGRAM, click.get_current_context().args)
