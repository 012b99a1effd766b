"""Finding datasets again after the database was lost: the coordinator's own program does it."""

import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from stickslip_services.cli.common import DatabaseOption, StoreOption, with_database
from stickslip_services.cli.errors import shows_errors
from stickslip_services.installed import require_server


@shows_errors
def reindex(
    data: Annotated[Path, typer.Option(help="data directory of the coordinator, which must not run")] = Path(
        "stickslip-data"
    ),
    store: StoreOption = None,
    database: DatabaseOption = None,
) -> None:
    """Find the datasets in the store again after the database was lost. What is known already stays as it is."""
    require_server("reindex")
    program = [sys.executable, "-m", "stickslip_services.coordinator", "--reindex", "--data", str(data)]
    place = [] if store is None else ["--store", store]
    ended = subprocess.run([*program, *place], capture_output=True, text=True, check=False, env=with_database(database))
    typer.echo(ended.stdout, nl=False)
    typer.echo(ended.stderr, nl=False, err=True)
    raise typer.Exit(ended.returncode)
