"""What commands share: their argument, mistakes that a user can do something about, and the progress of training."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from stickslip_training.data.sources import DatasetError

if TYPE_CHECKING:
    from stickslip_training.engine.fit import EpochReport

_SECONDS_BETWEEN_LINES = 5.0  # epochs of a small dataset take less

DatasetArgument = Annotated[
    str, typer.Argument(metavar="DATASET", help="directory or URL of a dataset version, .../versions/1")
]


@contextmanager
def readable_errors() -> Iterator[None]:
    """Turn what a user can do something about into one line and the exit status 1."""
    try:
        yield
    except (DatasetError, ValueError, OSError, ImportError) as error:
        Console(stderr=True).print(f"stickslip-train: {error}", style="red", soft_wrap=True, markup=False)
        raise typer.Exit(1) from error


def shows_epochs(console: Console, steps: int) -> "Callable[[EpochReport], None]":
    """Return what prints a line about an epoch, unless the last line was just printed."""
    shown_at = -math.inf

    def show(epoch: "EpochReport") -> None:
        nonlocal shown_at
        if epoch.seconds < shown_at + _SECONDS_BETWEEN_LINES:
            return
        shown_at = epoch.seconds
        validation = "" if epoch.validation_loss is None else f", validation {epoch.validation_loss:.3f}"
        console.print(f"step {epoch.step} of {steps}: loss {epoch.train_loss:.3f}{validation}, {epoch.seconds:.0f} s")

    return show
