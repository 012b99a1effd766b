"""Options, tables, JSON output and errors (field, rule and value, without a traceback), shared by
the commands.
"""

import functools
import json
import math
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import click
from click.exceptions import Exit
from pydantic import BaseModel
from stickslip_schemas.documents.problems import FieldError
from stickslip_schemas.transport.addresses import DEFAULT_URL

from stickslip_services.client.errors import (
    ClientError,
    MissingExtraError,
    ProblemError,
    UnreachableError,
)
from stickslip_services.client.http import Client
from stickslip_services.errors import CommandError, StickslipError

P = ParamSpec("P")
R = TypeVar("R")

FILE = click.Path(path_type=Path)
ARRAYS = frozenset({"google_crc32c", "numcodecs", "numpy", "obstore", "scipy", "zarr"})
"""Packages that the extra `arrays` installs; of others, commands that need them need the server."""
_LEAST_SENTENCE = 30
"""Least width of a column of sentences [characters]."""

_url_option = click.option(
    "--url", envvar="STICKSLIP_URL", default=DEFAULT_URL, help="where the coordinator is"
)
json_option = click.option("--json", "as_json", is_flag=True, help="print JSON for programs")
spec_argument = click.argument("file", type=FILE, help="a JobSpec, YAML or JSON")
job_argument = click.argument("job_id", metavar="JOB", help="id of a job")


def amount(unit: str, least: float) -> Callable[[str], float]:
    """Return the type of an option that is a finite number of a unit."""

    def read(text: str) -> float:
        with suppress(ValueError):
            if least <= float(text) < math.inf:
                return float(text)
        raise click.BadParameter(f"must be a number of {unit}, {least:g} or more, and is {text!r}")

    return read


def say(text: str) -> None:
    """Print a message for people on standard error; standard output is for programs."""
    click.echo(text, err=True)


def print_json(value: BaseModel | list[Any]) -> None:
    if isinstance(value, BaseModel):
        click.echo(value.model_dump_json(indent=2))
    else:
        click.echo(json.dumps([item.model_dump(mode="json") for item in value], indent=2))


def room() -> int:
    """Return the width of the terminal; there is no limit if the output is no terminal."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else sys.maxsize


def print_table(
    heads: Sequence[str], rows: Iterable[Sequence[str]], *, sentences: bool = False
) -> None:
    """Print rows under their heads.

    Columns come by importance: in a narrow terminal the last ones are left out.

    With `sentences`, the last column is text, which stays and is wrapped between words.
    """
    lines = (
        [tuple(click.style(head, bold=True) for head in heads), *rows] if any(heads) else list(rows)
    )
    widths = [max(map(_width, column)) for column in zip(*lines, strict=True)]
    columns = list(range(len(widths)))
    if sentences and widths:
        widths[-1] = min(
            widths[-1], max(_LEAST_SENTENCE, room() - sum(widths[:-1]) - 2 * len(widths) + 2)
        )
    while (
        len(columns) > 1 + sentences and sum(widths[column] + 2 for column in columns) - 2 > room()
    ):
        columns.pop(-1 - sentences)
    for line in lines:
        cells = [line[column] for column in columns]
        text = (
            textwrap.wrap(cells[-1], widths[-1], break_long_words=False, break_on_hyphens=False)
            if sentences
            else []
        )
        start = cells[:-1] if sentences else cells
        padded = [
            cell + " " * (widths[column] - _width(cell))
            for column, cell in zip(columns, start, strict=False)
        ]
        indent = "\n" + " " * sum(widths[column] + 2 for column in columns[:-1])
        click.echo("  ".join([*padded, indent.join(text)] if sentences else padded).rstrip())
    if len(columns) < len(widths):
        left_out = ", ".join(head for column, head in enumerate(heads) if column not in columns)
        say(f"not shown in {room()} columns: {left_out}; --json shows all")


def print_fields(fields: Iterable[tuple[str, str]]) -> None:
    """Print names and their values, one a line."""
    print_table(("", ""), fields, sentences=True)


def _width(text: str) -> int:
    return len(click.unstyle(text))


def field_line(field: FieldError) -> str:
    """Return a line that names a field of a document, the rule that it breaks, and its value."""
    place = field.pointer.lstrip("/").replace("/", ".") or "the document"
    return f"  {place}: {field.rule}" + (f", and it is {field.value}" if field.value else "")


def shows_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Print the errors that a command expects, and exit with status 1."""

    @functools.wraps(command)
    def run(*arguments: P.args, **options: P.kwargs) -> R:
        try:
            return command(*arguments, **options)
        except ProblemError as error:
            _print_error(
                error.problem.detail if not error.problem.errors else "the document is not valid"
            )
            for field in error.problem.errors:
                say(field_line(field))
            if error.problem.request_id and error.problem.status >= 500:
                say(f"  request {error.problem.request_id}; the coordinator's log says more")
        except UnreachableError as error:
            _print_error(
                f"{error}. Is a coordinator running there? `stickslip up` starts one on this machine; "
                "--url or STICKSLIP_URL names another."
            )
        except (ClientError, CommandError, StickslipError) as error:
            _print_error(str(error))
        except OSError as error:
            _print_error(f"{error.filename or 'the file system'}: {error.strerror or error}")
        except ModuleNotFoundError as error:
            package = (error.name or "stickslip").partition(".")[0]
            if package.startswith("stickslip") or find_spec(package):
                raise
            extra, what = ("arrays", "arrays") if package in ARRAYS else ("server", "the server")
            _print_error(str(MissingExtraError(extra, f"this needs {what}, and {error.name}")))
        raise Exit(1)

    return run


def asks(command: Callable[..., R]) -> Callable[..., R]:
    """Give a command a client of the coordinator at `--url`, and show its errors."""

    @functools.wraps(command)
    def run(url: str, **options: Any) -> R:
        with Client(url) as client:
            return command(client, **options)

    return _url_option(shows_errors(run))


def _print_error(message: str) -> None:
    say(f"{click.style('error:', bold=True, fg='red')} {message}")
