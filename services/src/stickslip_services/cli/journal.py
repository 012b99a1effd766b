"""The journal of a data directory: who changed what, and when."""

import json
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from stickslip_services.cli.common import DEFAULT_DATA, DatabaseOption, DataOption, console, table
from stickslip_services.cli.errors import shows_errors
from stickslip_services.installed import require_server

if TYPE_CHECKING:
    from sqlalchemy import Connection


def _visited(data: Path, database: str | None) -> AbstractContextManager["Connection"]:
    require_server("journal")
    from stickslip_services.access.audit_log import visited  # the server's packages may be missing

    return visited(data, database)


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
    with _visited(data, database) as connection:
        from stickslip_services.access.audit_log import read_audit_log

        lines = read_audit_log(connection, subject=subject, limit=limit)
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
