"""Removing versions and unused files of a coordinator that does not run: its own program does it."""

import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from stickslip_services.cli.common import DatabaseOption, StoreOption, with_database
from stickslip_services.cli.errors import shows_errors
from stickslip_services.installed import require_server

DataOption = Annotated[Path, typer.Option(help="data directory of the coordinator, which must not run")]
DEFAULT_DATA = Path("stickslip-data")


@shows_errors
def rm(
    version: Annotated[str, typer.Argument(metavar="DATASET:vN", help="the version to remove")],
    data: DataOption = DEFAULT_DATA,
    store: StoreOption = None,
    database: DatabaseOption = None,
) -> None:
    """Remove a version of a dataset, with its jobs and the results that no other job needs.

    The space is free after `stickslip gc --delete`. A spec that is submitted again makes the dataset again.
    """
    _run("rm", [version], data, store, database)


@shows_errors
def gc(
    data: DataOption = DEFAULT_DATA,
    store: StoreOption = None,
    older_than: Annotated[float, typer.Option(min=0, metavar="HOURS", help="keep files written since then")] = 24.0,
    delete: Annotated[bool, typer.Option("--delete", help="delete the files; without, only count them")] = False,
    database: DatabaseOption = None,
) -> None:
    """Find the files of the store that nothing refers to, and delete them with --delete."""
    _run("gc", ["--older-than", str(older_than), *["--delete"] * delete], data, store, database)


def _run(verb: str, options: list[str], data: Path, store: str | None, database: str | None) -> None:
    require_server(verb)
    place = ["--data", str(data), *([] if store is None else ["--store", store])]
    program = [sys.executable, "-m", "stickslip_services.upkeep", verb, *place, *options]
    ended = subprocess.run(program, capture_output=True, text=True, check=False, env=with_database(database))
    typer.echo(ended.stdout, nl=False)
    typer.echo(ended.stderr, nl=False, err=True)
    raise typer.Exit(ended.returncode)
