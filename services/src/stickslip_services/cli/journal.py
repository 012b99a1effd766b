"""The journal of a data directory: who changed what, and when."""

import json
from typing import Annotated

import typer
from rich.markup import escape

from stickslip_services.cli.common import DEFAULT_DATA, DatabaseOption, DataOption, console, table, writing
from stickslip_services.cli.errors import shows_errors


@shows_errors
def journal(
    subject: Annotated[
        str | None, typer.Argument(metavar="ID", help="only what was done to this job, version, key or webhook")
    ] = None,
    data: DataOption = DEFAULT_DATA,
    database: DatabaseOption = None,
    limit: Annotated[int, typer.Option(min=1, help="how many lines, from the last one back")] = 100,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON document a line, for programs")] = False,
) -> None:
    """Show who changed what, and when, newest first."""
    with writing("journal", data, database) as connection:
        from stickslip_services.journal import read_journal

        lines = read_journal(connection, subject=subject, limit=limit)
    if as_json:
        for line in lines:
            document = {"at": line.at.isoformat(), "actor": line.actor, "action": line.action, "subject": line.subject}
            typer.echo(json.dumps(document | {"details": line.details}))
        return
    shown = table("when", "who", "what", "to what", "details", no_wrap=("when", "what", "to what"))
    for line in lines:
        details = ", ".join(f"{name} {value}" for name, value in line.details.items())
        shown.add_row(f"{line.at:%Y-%m-%d %H:%M:%S}", escape(line.actor), line.action, line.subject, escape(details))
    console().print(shown)
