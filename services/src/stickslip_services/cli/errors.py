"""Errors on the command line: field, rule and value, without a traceback."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import typer
from rich.console import Console
from rich.markup import escape

from stickslip_services.cli.specs import field_line
from stickslip_services.client.errors import ClientError, ProblemError, UnreachableError
from stickslip_services.errors import CommandError, StickslipError

P = ParamSpec("P")
R = TypeVar("R")


def shows_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Print the errors that a command expects, and exit with status 1."""

    @functools.wraps(command)
    def run(*arguments: P.args, **options: P.kwargs) -> R:
        try:
            return command(*arguments, **options)
        except ProblemError as error:
            _print(error.problem.detail if not error.problem.errors else "the document is not valid")
            for field in error.problem.errors:
                _print_line(escape(field_line(field)))
            if error.problem.request_id and error.problem.status >= 500:
                _print_line(f"  request {escape(error.problem.request_id)}; the coordinator's log says more")
        except UnreachableError as error:
            _print(
                f"{error}. Is a coordinator running there? `stickslip up` starts one on this machine; "
                "--url or STICKSLIP_URL names another."
            )
        except (ClientError, CommandError, StickslipError) as error:
            _print(str(error))
        except OSError as error:
            _print(f"{error.filename or 'the file system'}: {error.strerror or error}")
        raise typer.Exit(1)

    return run


def _print(message: str) -> None:
    _print_line(f"[bold red]error:[/] {escape(message)}")


def _print_line(markup: str) -> None:
    Console(stderr=True, soft_wrap=True, highlight=False).print(markup)
