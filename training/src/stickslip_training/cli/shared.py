"""Parts that all commands of `stickslip-train` use: errors in one line, and lines of progress."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from stickslip_training.data.sources import DatasetError

if TYPE_CHECKING:
    from stickslip_training.engine.fit import EpochReport

_SECONDS_BETWEEN_LINES = 5.0
"""Shortest time between two lines of progress [s]: epochs of a small dataset take less."""

DatasetArgument = Annotated[
    str,
    typer.Argument(metavar="DATASET", help="directory or URL of a dataset version, .../versions/1"),
]


@contextmanager
def readable_errors() -> Iterator[None]:
    """Print errors that a user can mend as one line, and exit with the status 1."""
    try:
        yield
    except (DatasetError, ValueError, OSError, ImportError) as error:
        Console(stderr=True).print(
            f"stickslip-train: {error}", style="red", soft_wrap=True, markup=False
        )
        raise typer.Exit(1) from error


def report_epochs(console: Console, steps: int) -> "Callable[[EpochReport], None]":
    """Return a function that prints a line about an epoch, with the time left.

    The function prints nothing if it has just printed a line.
    """
    last_line = -math.inf  # [s of training]

    def report(epoch: "EpochReport") -> None:
        nonlocal last_line
        if epoch.seconds < last_line + _SECONDS_BETWEEN_LINES:
            return
        last_line = epoch.seconds
        line = f"step {epoch.step} of {steps}: loss {epoch.train_loss:.3f}"
        if epoch.validation_loss is not None:
            line += f", validation {epoch.validation_loss:.3f}"
        line += f", {epoch.seconds:.0f} s"
        # Steps cost about the same, so the rest takes as long in proportion.
        if epoch.step < steps:
            line += f", {time_left(epoch.seconds * (steps - epoch.step) / epoch.step)} left"
        console.print(line)

    return report


def time_left(seconds: float) -> str:
    """Return a rounded time: seconds below 100 s, and minutes above."""
    if seconds < 100:
        return f"about {max(1, round(seconds))} s"
    return f"about {round(seconds / 60)} min"
