"""The commands of `stickslip`, by name."""

from collections.abc import Callable
from typing import Annotated

import typer

from stickslip_services import __version__
from stickslip_services.cli.admin import audit_log, keys, projects, webhooks
from stickslip_services.cli.certificates import certificates, certify, register
from stickslip_services.cli.datasets import app as datasets
from stickslip_services.cli.datasets import export, pull_dataset, verify
from stickslip_services.cli.jobs import (
    cancel,
    jobs,
    pause,
    prioritise,
    resume,
    show,
    submit,
    upload,
    validate,
    watch_job,
)
from stickslip_services.cli.maintenance import gc, reindex, rm
from stickslip_services.cli.scenes import app as scenes
from stickslip_services.cli.scenes import simulate
from stickslip_services.cli.service import up, workers

app = typer.Typer(
    name="stickslip",
    help="Physically verified synthetic datasets of slender things.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.callback(invoke_without_command=True)
def _main(version: Annotated[bool, typer.Option("--version", help="print the version")] = False) -> None:
    if version:
        typer.echo(f"stickslip {__version__}")
        raise typer.Exit


_COMMANDS: dict[str, Callable[..., None]] = {
    "up": up,
    "workers": workers,
    "validate": validate,
    "upload": upload,
    "submit": submit,
    "jobs": jobs,
    "show": show,
    "watch": watch_job,
    "pause": pause,
    "resume": resume,
    "priority": prioritise,
    "cancel": cancel,
    "pull": pull_dataset,
    "verify": verify,
    "rm": rm,
    "gc": gc,
    "reindex": reindex,
    "simulate": simulate,
    "certify": certify,
    "register": register,
    "certificates": certificates,
    "audit-log": audit_log,
}

for _name, _command in _COMMANDS.items():
    app.command(name=_name)(_command)
_PASSING = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
app.command(name="export", context_settings=_PASSING)(export)

app.add_typer(datasets, name="datasets")
app.add_typer(keys, name="keys")
app.add_typer(projects, name="projects")
app.add_typer(scenes, name="scene")
app.add_typer(webhooks, name="webhooks")
