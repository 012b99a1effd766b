"""Errors on the command line: field, rule and value, without a traceback."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import click
from click.exceptions import Exit

from stickslip_services.cli.common import data_option, database_option, say, url_option
from stickslip_services.cli.specs import field_line
from stickslip_services.client.errors import ClientError, MissingExtraError, ProblemError, UnreachableError
from stickslip_services.errors import CommandError, StickslipError

P = ParamSpec("P")
R = TypeVar("R")

ARRAYS = frozenset({"google_crc32c", "numcodecs", "numpy", "obstore", "scipy", "zarr"})
"""Modules that the extra `arrays` installs; one that is missing is no fault of ours."""


def shows_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Print the errors that a command expects, and exit with status 1."""

    @functools.wraps(command)
    def run(*arguments: P.args, **options: P.kwargs) -> R:
        try:
            return command(*arguments, **options)
        except ProblemError as error:
            _print(error.problem.detail if not error.problem.errors else "the document is not valid")
            for field in error.problem.errors:
                say(field_line(field))
            if error.problem.request_id and error.problem.status >= 500:
                say(f"  request {error.problem.request_id}; the coordinator's log says more")
        except UnreachableError as error:
            _print(
                f"{error}. Is a coordinator running there? `stickslip up` starts one on this machine; "
                "--url or STICKSLIP_URL names another."
            )
        except (ClientError, CommandError, StickslipError) as error:
            _print(str(error))
        except OSError as error:
            _print(f"{error.filename or 'the file system'}: {error.strerror or error}")
        except ModuleNotFoundError as error:
            if error.name is None or error.name.partition(".")[0] not in ARRAYS:
                raise
            _print(str(MissingExtraError("arrays", f"this needs arrays, and {error.name}")))
        raise Exit(1)

    return run


def asks(command: Callable[P, R]) -> Callable[P, R]:
    """Give a command the option `--url` of a coordinator, and show its errors."""
    return url_option(shows_errors(command))


def administers(command: Callable[P, R]) -> Callable[P, R]:
    """Give a command the options of a coordinator's database, and show its errors."""
    return data_option(database_option(shows_errors(command)))


def _print(message: str) -> None:
    say(f"{click.style('error:', bold=True, fg='red')} {message}")
