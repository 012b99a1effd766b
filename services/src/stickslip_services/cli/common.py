"""Options, the console and JSON output, shared by the commands."""

import json
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel
from rich.console import Console
from rich.table import Table

from stickslip_services.errors import ServerNotInstalledError

UrlOption = Annotated[str, typer.Option("--url", envvar="STICKSLIP_URL", help="where the coordinator is")]
JsonOption = Annotated[bool, typer.Option("--json", help="print JSON for programs")]
SpecArgument = Annotated[Path, typer.Argument(metavar="FILE", help="a JobSpec, YAML or JSON")]
DatabaseOption = Annotated[
    str | None,
    typer.Option("--database", help="URL of a PostgreSQL database; give one with a password as STICKSLIP_DATABASE"),
]
StoreOption = Annotated[
    str | None, typer.Option(help="directory of the store, or s3://BUCKET/PREFIX, if it is not DATA/store")
]
DataOption = Annotated[Path, typer.Option(help="data directory of the coordinator")]
DEFAULT_DATA = Path("stickslip-data")
_SERVER_MODULES = ("alembic", "fastapi", "jinja2", "prometheus_client", "pydantic_settings", "sqlalchemy", "uvicorn")
JobArgument = Annotated[str, typer.Argument(metavar="JOB", help="id of a job")]


def console() -> Console:
    """Return a console as wide as the terminal, or 200 columns wide if the output is no terminal."""
    return Console(soft_wrap=True, highlight=False, width=None if sys.stdout.isatty() else 200)


def say(text: str) -> None:
    """Print a message for people on standard error; standard output is for programs."""
    typer.echo(text, err=True)


def print_json(value: BaseModel | list[Any]) -> None:
    """Print documents as JSON."""
    if isinstance(value, BaseModel):
        typer.echo(value.model_dump_json(indent=2))
    else:
        typer.echo(json.dumps([item.model_dump(mode="json") for item in value], indent=2))


def table(*columns: str, no_wrap: tuple[str, ...] = ()) -> Table:
    """Return an empty table; columns in `no_wrap` are never wrapped."""
    made = Table(box=None, header_style="bold")
    for column in columns:
        made.add_column(column, overflow="fold", no_wrap=column in no_wrap)
    return made


def require_server() -> None:
    """Raise ServerNotInstalledError if a package of the server is missing."""
    missing = [name for name in _SERVER_MODULES if find_spec(name) is None]
    if missing:
        raise ServerNotInstalledError(
            f"this command needs the server, and {', '.join(missing)} is not installed: "
            "pip install 'stickslip-services[server]'"
        )
