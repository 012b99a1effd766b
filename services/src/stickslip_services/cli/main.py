"""The commands of `stickslip`, by name."""

import ast
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from stickslip_services import __version__

_COMMANDS = {
    "up": "service.up",
    "workers": "service.workers",
    "validate": "jobs.validate",
    "upload": "jobs.upload",
    "submit": "jobs.submit",
    "jobs": "jobs.jobs",
    "show": "jobs.show",
    "watch": "jobs.watch_job",
    "pause": "jobs.pause",
    "resume": "jobs.resume",
    "priority": "jobs.prioritise",
    "cancel": "jobs.cancel",
    "pull": "datasets.pull_dataset",
    "sign": "datasets.sign",
    "verify": "datasets.verify",
    "rm": "maintenance.rm",
    "gc": "maintenance.gc",
    "reindex": "maintenance.reindex",
    "scrub": "maintenance.scrub",
    "scene": "scenes.scenes",
    "simulate": "scenes.simulate",
    "certify": "certificates.certify",
    "register": "certificates.register",
    "certificates": "certificates.certificates",
    "keys": "admin.keys",
    "projects": "admin.projects",
    "webhooks": "admin.webhooks",
    "audit-log": "admin.audit_log",
    "datasets": "datasets.datasets",
    "export": "datasets.export",
}
"""Module and function of each command, or module and Typer of a group of commands."""
_PASSING = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
_SETTINGS: dict[str, dict[str, Any]] = {"export": _PASSING}


@cache
def _loaded(name: str) -> Any:
    """Return a command, of whose module the import takes most of the time of a short command."""
    module, attribute = _COMMANDS[name].split(".")
    if module in ("admin", "maintenance"):  # they import the server, which a client lacks
        from stickslip_services.cli.common import require_server
        from stickslip_services.cli.errors import shows_errors

        shows_errors(require_server)()
    command = getattr(import_module(f"stickslip_services.cli.{module}"), attribute)
    if isinstance(command, typer.Typer):
        return typer.main.get_group(command)
    alone = typer.Typer(add_completion=False)
    alone.command(name, context_settings=_SETTINGS.get(name))(command)
    return typer.main.get_command(alone)


@cache
def _source(module: str) -> list[ast.stmt]:
    return ast.parse(Path(__file__).with_name(f"{module}.py").read_text()).body


def _help(name: str) -> str:
    """Return what a command's source says about it: the docstring of a function, or the help of a Typer."""
    module, attribute = _COMMANDS[name].split(".")
    for node in _source(module):
        if isinstance(node, ast.FunctionDef) and node.name == attribute:
            return ast.get_docstring(node) or ""
        if (
            isinstance(node, ast.Assign)
            and ast.unparse(node.targets[0]) == attribute
            and isinstance(node.value, ast.Call)
        ):
            return next(str(ast.literal_eval(word.value)) for word in node.value.keywords if word.arg == "help")
    raise LookupError(f"{module}.py defines no {attribute}")


class _Commands(TyperGroup):
    """Imports a command when it is called, and only reads about it when it is listed."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> TyperCommand | None:
        return TyperCommand(cmd_name, help=_help(cmd_name)) if cmd_name in _COMMANDS else None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        self.commands = {known: TyperCommand(known) for known in _COMMANDS}  # near names are looked for here
        name, listed, rest = super().resolve_command(ctx, args)
        return name, listed and _loaded(str(name)), rest


app = typer.Typer(
    name="stickslip",
    cls=_Commands,
    help="Physically verified synthetic datasets of slender things.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@app.callback(invoke_without_command=True)
def _main(version: Annotated[bool, typer.Option("--version", help="print the version")] = False) -> None:
    if version:
        typer.echo(f"stickslip {__version__}")
        raise typer.Exit
