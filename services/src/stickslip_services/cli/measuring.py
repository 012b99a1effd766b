"""The command that measures a simulator."""

import click

from stickslip_services.cli.common import shows_errors
from stickslip_services.cli.passed_on import PASSES_ARGUMENTS, Program, run_program

_PROGRAM = Program(
    command="measure",
    package="measuring",
    distribution="stickslip-measure",
    extra="page",
    module="stickslip_measure",
)


@click.command(context_settings=PASSES_ARGUMENTS)
@shows_errors
def measure() -> None:
    """Measure the friction and bending of any simulator.

    Passes all arguments on to `stickslip-measure`. It needs no coordinator.
    """
    # Its usage and its errors then name the command that the user typed.
    variables = {"STICKSLIP_MEASURE_PROGRAM": "stickslip measure"}
    run_program(_PROGRAM, click.get_current_context().args, variables)
