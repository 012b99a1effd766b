"""The command line `stickslip`: its commands by name."""

import ast
import os
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from stickslip_services import __version__

_COMMANDS = {
    name: (module, name.replace("-", "_"))
    for module, names in (
        ("admin", "up"),
        ("workers", "workers"),
        ("jobs", "validate upload submit jobs show watch pause resume priority cancel"),
        ("datasets", "pull sign verify"),
        ("maintenance", "rm gc reindex scrub"),
        ("specs", "scene simulate"),
        ("workers", "certify register certificates"),
        ("admin", "keys projects webhooks audit-log"),
        ("datasets", "datasets export"),
    )
    for name in names.split()
}
"""Module and function of each command."""

_COMPLETIONS = {
    "bash": ("~/.bashrc", 'eval "$(_STICKSLIP_COMPLETE=bash_source stickslip)"'),
    "zsh": ("~/.zshrc", 'eval "$(_STICKSLIP_COMPLETE=zsh_source stickslip)"'),
    "fish": (
        "~/.config/fish/completions/stickslip.fish",
        "_STICKSLIP_COMPLETE=fish_source stickslip | source",
    ),
}
"""File of each shell, and the line in it that completes our commands."""


@cache
def _loaded(name: str) -> click.Command:
    """Return a command, of whose module the import takes most of the time of a short command."""
    from stickslip_services.cli.common import (
        shows_errors,
    )  # some need the server, which a client lacks

    module, attribute = _COMMANDS[name]
    command: click.Command = getattr(
        shows_errors(import_module)(f"stickslip_services.cli.{module}"), attribute
    )
    return command


@cache
def _source(module: str) -> list[ast.stmt]:
    return ast.parse(Path(__file__).with_name(f"{module}.py").read_text()).body


def _help(name: str) -> str:
    """Return the docstring of a command, from its source."""
    module, attribute = _COMMANDS[name]
    found = (
        node
        for node in _source(module)
        if isinstance(node, ast.FunctionDef) and node.name == attribute
    )
    return ast.get_docstring(next(found)) or ""


class _Commands(click.Group):
    """Imports a command when it is called, and only reads about it when it is listed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        return click.Command(cmd_name, help=_help(cmd_name)) if cmd_name in _COMMANDS else None

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[Any, Any, list[str]]:
        self.commands = {
            known: click.Command(known) for known in _COMMANDS
        }  # near names are looked for here
        name, listed, rest = super().resolve_command(ctx, args)
        return name, listed and _loaded(str(name)), rest


def _install_completion(ctx: click.Context, _: click.Parameter, shell: str | None) -> None:
    if shell is None:
        return
    place, line = _COMPLETIONS[shell]
    file = Path(place).expanduser()
    file.parent.mkdir(parents=True, exist_ok=True)
    if not file.exists() or line not in file.read_text():
        with file.open("a") as target:
            target.write(f"{line}\n")
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
