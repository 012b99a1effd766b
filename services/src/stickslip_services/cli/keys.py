"""API keys: making, listing and revoking them, in the database of a data directory.

Whoever may write the data directory may make keys: no key is needed for that, and no coordinator has to run.
"""

import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from stickslip_services.access.scopes import Scope
from stickslip_services.cli.common import DEFAULT_DATA, DatabaseOption, DataOption, console, say, table
from stickslip_services.cli.errors import shows_errors
from stickslip_services.installed import require_server

if TYPE_CHECKING:
    from sqlalchemy import Connection

app = typer.Typer(help="Make, list and revoke API keys.", no_args_is_help=True)


def visited_database(data: Path, database: str | None) -> AbstractContextManager["Connection"]:
    """Open the database of a coordinator, which may run, for a few rows."""
    require_server("keys")
    from stickslip_services.access.audit_log import visited  # the server's packages may be missing

    return visited(data, database)


@app.command()
@shows_errors
def create(
    name: Annotated[str, typer.Argument(help="whose key it is, or what for")],
    scope: Annotated[list[Scope], typer.Option(help="what it is for; repeatable. submit includes read, admin all")],
    project: Annotated[
        str, typer.Option(help="whose jobs it submits: projects share leases, and may have quotas")
    ] = "",
    data: DataOption = DEFAULT_DATA,
    database: DatabaseOption = None,
) -> None:
    """Make a key and print it. It is shown this once: only its digest is kept."""
    with visited_database(data, database) as connection:
        from stickslip_services.access.keys import create_key

        key, secret = create_key(connection, name, scope, time.time(), project=project)
    typer.echo(secret)
    say(f"{key.id} is made. Keep the key: it cannot be shown again. Use it as STICKSLIP_KEY, or in the header")
    say("Authorization: Bearer KEY; a browser takes it as the password of any user")


@app.command("list")
@shows_errors
def list_(data: DataOption = DEFAULT_DATA, database: DatabaseOption = None) -> None:
    """List keys, also the revoked ones, newest first."""
    with visited_database(data, database) as connection:
        from stickslip_services.access.keys import list_keys

        found = list_keys(connection)
    shown = table("key", "name", "scopes", "project", "made", "revoked", no_wrap=("key",))
    for key in found:
        shown.add_row(
            key.id,
            escape(key.name),
            ", ".join(scope for scope in Scope if scope in key.scopes),
            key.project,
            f"{key.created_at:%Y-%m-%d %H:%M}",
            "" if key.revoked_at is None else f"{key.revoked_at:%Y-%m-%d %H:%M}",
        )
    console().print(shown)


@app.command()
@shows_errors
def revoke(
    key_id: Annotated[str, typer.Argument(metavar="KEY", help="id of a key, as `stickslip keys list` shows it")],
    data: DataOption = DEFAULT_DATA,
    database: DatabaseOption = None,
) -> None:
    """Let a key open nothing any more; a running coordinator knows it within a second."""
    with visited_database(data, database) as connection:
        from stickslip_services.access.keys import revoke_key

        revoke_key(connection, key_id, time.time())
    typer.echo(f"{key_id} is revoked")
