"""Mistakes that a user can do something about, and the argument that all commands share."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer
from rich.console import Console

from stickslip_training.data.errors import DatasetError

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
