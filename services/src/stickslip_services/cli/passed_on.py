"""Commands whose arguments go on to the program of another distribution."""

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from types import MappingProxyType
from typing import Any, NoReturn

from click.exceptions import Exit
from stickslip_schemas.installation import install_hint

from stickslip_services.client.errors import ClientError

PASSES_ARGUMENTS: dict[str, Any] = {
    "allow_extra_args": True,
    "ignore_unknown_options": True,
    "help_option_names": [],
}
"""click's settings of such a command: options and --help are those of the program."""


@dataclass(frozen=True)
class Program:
    """A program of a distribution that may be missing."""

    command: str
    """Name of our command."""
    package: str
    """Name of the distribution in a sentence."""
    distribution: str
    extra: str
    """Extra of the distribution that the command needs."""
    module: str
    """Module that Python runs."""
    words: tuple[str, ...] = ()
    """Arguments before those of the user."""


def require_program(program: Program) -> None:
    """Raise ClientError if the distribution of a program is not installed."""
    if find_spec(program.module.partition(".")[0]) is None:
        raise ClientError(
            f"`stickslip {program.command}` needs the {program.package} package: "
            + install_hint(program.distribution, program.extra)
        )


def run_program(
    program: Program,
    arguments: Sequence[str],
    variables: Mapping[str, str] = MappingProxyType({}),
) -> NoReturn:
    """Run a program, and exit with its status.

    Args:
        program: The program.
        arguments: Arguments of the user.
        variables: Variables of the environment besides our own.

    Raises:
        ClientError: The distribution is not installed.
    """
    require_program(program)
    # In a process of its own: what the program imports is heavy, and may be missing.
    process = subprocess.run(
        [sys.executable, "-m", program.module, *program.words, *arguments],
        env=os.environ | variables,
        check=False,
    )
    raise Exit(process.returncode)
