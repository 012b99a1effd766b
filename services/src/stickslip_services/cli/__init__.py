"""The command line `stickslip`: its commands by name."""

import ast
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import NamedTuple, NoReturn

import click

from stickslip_services import __version__

_SECTIONS = {
    "Service": {"up": "admin", "workers": "workers"},
    "Jobs": dict.fromkeys(
        (
            "validate",
            "upload",
            "submit",
            "jobs",
            "show",
            "watch",
            "pause",
            "resume",
            "priority",
            "cancel",
        ),
        "jobs",
    ),
    "Datasets": dict.fromkeys(("datasets", "pull", "verify", "sign", "export"), "datasets"),
    "Scenes": {"scene": "specs", "simulate": "specs", "fit": "fitting"},
    "Fabrics": dict.fromkeys(("fabrics", "lab"), "laboratory"),
    "Certificates": dict.fromkeys(("certify", "register", "certificates"), "workers"),
    "Measurement": {"measure": "measuring", "rods": "rods", "film": "filming"},
    "Administration": dict.fromkeys(("keys", "projects", "webhooks", "audit-log"), "admin"),
    "Maintenance": dict.fromkeys(("backup", "rm", "gc", "reindex", "scrub"), "maintenance"),
}
"""Module of each command, by section of the help."""


class _Location(NamedTuple):
    """The function of a command."""

    module: str
    function: str


def _locate_commands() -> dict[str, _Location]:
    locations = {}
    for section in _SECTIONS.values():
        for name, module in section.items():
            locations[name] = _Location(module, name.replace("-", "_"))
    return locations


_COMMANDS = _locate_commands()


class _Completion(NamedTuple):
    """The line that completes our commands in a shell, and the file that it belongs in."""

    file: str
    line: str


_COMPLETIONS = {
    "bash": _Completion("~/.bashrc", 'eval "$(_STICKSLIP_COMPLETE=bash_source stickslip)"'),
    "zsh": _Completion("~/.zshrc", 'eval "$(_STICKSLIP_COMPLETE=zsh_source stickslip)"'),
    "fish": _Completion(
        "~/.config/fish/completions/stickslip.fish",
        "_STICKSLIP_COMPLETE=fish_source stickslip | source",
    ),
}


@cache
def _loaded(name: str) -> click.Command:
    """Return a command; importing its module takes most of the time of a short command."""
    # Some commands need the server, which a client lacks: then the error names the extra.
    from stickslip_services.cli.common import shows_errors

    location = _COMMANDS[name]
    module = shows_errors(import_module)(f"stickslip_services.cli.{location.module}")
    command: click.Command = getattr(module, location.function)
    return command


@cache
def _source(module: str) -> list[ast.stmt]:
    return ast.parse(Path(__file__).with_name(f"{module}.py").read_text()).body


def _help(name: str) -> str:
    """Return the docstring of a command from its source, so that the list imports nothing."""
    # A parsed file costs 3 CPU ms, and an imported one up to 600.
    location = _COMMANDS[name]
    for statement in _source(location.module):
        if isinstance(statement, ast.FunctionDef) and statement.name == location.function:
            return ast.get_docstring(statement) or ""
    raise AssertionError(f"{location.module} has no function {location.function}")


@contextmanager
def _ending_with_its_reader() -> Iterator[None]:
    """End as Unix programs do if the reader of the output has gone: by SIGPIPE, in silence.

    Python ignores the signal, because sockets must survive it. So it is sent only here.
    """
    try:
        yield
    except BrokenPipeError:
        _end_by_sigpipe()


def _end_by_sigpipe() -> NoReturn:
    # With its default action the signal ends the process, and the shell sees why.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    os.kill(os.getpid(), signal.SIGPIPE)
    raise AssertionError("the signal ends the program")


class _Commands(click.Group):
    """Imports a command when it is called, and only reads about it when it is listed."""

    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: click.Context | None = None,
        **extra: object,
    ) -> click.Context:
        """Read the command line; `--help` and `--version` print and end here."""
        with _ending_with_its_reader():
            return super().make_context(info_name, args, parent, **extra)

    def invoke(self, ctx: click.Context) -> object:
        """Run the command."""
        with _ending_with_its_reader():
            return super().invoke(ctx)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands, in the order of the help."""
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command that has only its help; None if there is none of this name."""
        return click.Command(cmd_name, help=_help(cmd_name)) if cmd_name in _COMMANDS else None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that is called."""
        # click compares a misspelt name with these.
        self.commands = {name: click.Command(name) for name in _COMMANDS}
        name, listed, rest = super().resolve_command(ctx, args)
        return name, listed and _loaded(str(name)), rest

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands by section, each with its whole first sentence."""
        for title, names in _SECTIONS.items():
            # write_dl wraps between words, so no sentence is cut.
            rows = [(name, _help(name).split("\n\n")[0].replace("\n", " ")) for name in names]
            with formatter.section(title):
                formatter.write_dl(rows)


def _install_completion(ctx: click.Context, _: click.Parameter, shell: str | None) -> None:
    # Without the option there is nothing to do, and the command goes on.
    if shell is None:
        return
    completion = _COMPLETIONS[shell]
    file = Path(completion.file).expanduser()
    file.parent.mkdir(parents=True, exist_ok=True)
    # A second call must not add the line again.
    if not file.exists() or completion.line not in file.read_text():
        with file.open("a") as stream:
            stream.write(f"{completion.line}\n")
    click.echo(f"{file} completes commands of stickslip, from the next {shell} on")
    ctx.exit()


@click.group("stickslip", cls=_Commands, context_settings={"show_default": True})
@click.version_option(__version__, message="stickslip %(version)s", help="print the version")
@click.option(
    "--install-completion",
    type=click.Choice(list(_COMPLETIONS)),
    is_flag=False,
    flag_value=Path(os.environ.get("SHELL", "bash")).name,
    is_eager=True,
    expose_value=False,
    callback=_install_completion,
    help="complete commands with the tabulator, in the shell that you use or name",
)
def app() -> None:
    """Physically verified synthetic datasets of slender things."""
