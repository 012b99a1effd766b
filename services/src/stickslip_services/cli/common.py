"""Options and errors that the commands share.

An error names field, rule and value, without a traceback.
"""

import functools
import math
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import ParamSpec, TypeVar

import click
from click.exceptions import Exit
from stickslip_schemas.documents.problems import FieldError
from stickslip_schemas.transport.addresses import DEFAULT_URL, URL_VARIABLE

from stickslip_services.cli.output import print_error, say
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
SERVER_ERROR = 500
"""From this status on, a problem is one of the coordinator, and its log says more."""

_url_option = click.option(
    "--url", envvar=URL_VARIABLE, default=DEFAULT_URL, help="where the coordinator is"
)
json_option = click.option("--json", "as_json", is_flag=True, help="print JSON for programs")
spec_argument = click.argument("file", type=FILE, help="a JobSpec, YAML or JSON")
job_argument = click.argument("job_id", metavar="JOB", help="id of a job")


class CommandGroup(click.Group):
    """A group whose help says the whole first sentence of each command."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the names of the commands and their first sentences, wrapped between words."""
        rows = []
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            if command is not None:
                rows.append((name, first_sentence(command.help or "")))
        with formatter.section("Commands"):
            formatter.write_dl(rows)


def first_sentence(text: str) -> str:
    """Return the first paragraph of a docstring on one line."""
    return " ".join(text.split("\n\n")[0].split())


def amount(unit: str, least: float, most: float = math.inf) -> Callable[[str], float]:
    """Return the type of an option that is a finite number of a unit, within limits."""
    limits = f"{least:g} or more" if most == math.inf else f"{least:g} to {most:g}"

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        # This refuses NaN, too, which compares with nothing.
        if not (least <= value <= most and value < math.inf):
            raise click.BadParameter(f"must be a number of {unit}, {limits}, and is {text!r}")
        return value

    return read


def field_line(field: FieldError) -> str:
    """Return a line that names a field of a document, the rule that it breaks, and its value."""
    path = field.pointer.lstrip("/").replace("/", ".") or "the document"
    value = f", and it is {field.value}" if field.value else ""
    return f"  {path}: {field.rule}{value}"


def shows_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Print the errors that a command expects, and exit with status 1."""

    @functools.wraps(command)
    def run(*arguments: P.args, **options: P.kwargs) -> R:
        try:
            return command(*arguments, **options)
        except BrokenPipeError:
            # The reader of the output has gone, which is no error: the group ends the program.
            raise
        except ProblemError as error:
            _print_problem(error)
        except UnreachableError as error:
            print_error(
                f"{error}. Is a coordinator running there? `stickslip up` starts one on this "
                f"machine; --url or {URL_VARIABLE} names another."
            )
        except (ClientError, CommandError, StickslipError) as error:
            print_error(str(error))
        except OSError as error:
            print_error(f"{error.filename or 'the file system'}: {error.strerror or error}")
        except ModuleNotFoundError as error:
            _print_missing_package(error)
        raise Exit(1)

    return run


def _print_problem(error: ProblemError) -> None:
    problem = error.problem
    print_error("the document is not valid" if problem.errors else problem.detail)
    for field in problem.errors:
        say(field_line(field))
    # The user can do nothing about an error of the coordinator, but its log can be searched.
    if problem.request_id and problem.status >= SERVER_ERROR:
        say(f"  request {problem.request_id}; the coordinator's log says more")


def _print_missing_package(error: ModuleNotFoundError) -> None:
    """Name the extra that brings a package; raise the error if the package is installed."""
    # A module of ours, or one of an installed package, is a bug and not a missing extra.
    package = (error.name or "stickslip").partition(".")[0]
    if package.startswith("stickslip") or find_spec(package):
        raise error
    extra, need = ("arrays", "arrays") if package in ARRAYS else ("server", "the server")
    print_error(str(MissingExtraError(extra, f"this needs {need}, and {error.name}")))


def asks(command: Callable[..., R]) -> Callable[..., R]:
    """Give a command a client of the coordinator at `--url`, and show its errors."""

    @functools.wraps(command)
    def run(url: str, **options: object) -> R:
        # The connections end with the command, also after an error.
        with Client(url) as client:
            return command(client, **options)

    return _url_option(shows_errors(run))
