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


def check_device(name: str) -> str:
    """Return the name of a device of torch; raise ValueError where this torch cannot use it."""
    import torch

    try:
        torch.empty(0, device=name)
    except (AssertionError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device must be one that this torch can use, such as cpu; {name!r}: {reason}") from error
    return name


@contextmanager
def errors_told() -> Iterator[None]:
    """Turn what a user can do something about into one line and the exit status 1."""
    try:
        yield
    except (DatasetError, ValueError, OSError, ImportError) as error:
        Console(stderr=True).print(f"stickslip-train: {error}", style="red", soft_wrap=True, markup=False)
        raise typer.Exit(1) from error
