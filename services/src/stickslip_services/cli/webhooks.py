"""Webhooks: making, listing, retrying and deleting them, in the database of a data directory, as with keys."""

import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from stickslip_services.cli.common import DEFAULT_DATA, DatabaseOption, DataOption, console, say, table
from stickslip_services.cli.errors import shows_errors
from stickslip_services.installed import require_server

if TYPE_CHECKING:
    from sqlalchemy import Connection

app = typer.Typer(help="Tell other programs what happens to jobs.", no_args_is_help=True)

IdArgument = Annotated[str, typer.Argument(metavar="WEBHOOK", help="id, as `stickslip webhooks list` shows it")]


def _visited(data: Path, database: str | None) -> AbstractContextManager["Connection"]:
    require_server("webhooks")
    from stickslip_services.access.audit_log import visited  # the server's packages may be missing

    return visited(data, database)


@app.command()
@shows_errors
def create(
    url: Annotated[str, typer.Argument(help="where messages are sent to: https://..., or http:// on this machine")],
    data: DataOption = DEFAULT_DATA,
    database: DatabaseOption = None,
) -> None:
    """Tell a receiver what happens from now on. Prints the secret with which it checks signatures."""
    with _visited(data, database) as connection:
        from stickslip_services.access.webhooks import create_webhook

        webhook, secret = create_webhook(connection, url, time.time())
    typer.echo(secret)
    say(f"{webhook.id} is made. The receiver checks messages with the secret, as standardwebhooks.com says")


@app.command("list")
@shows_errors
def list_(data: DataOption = DEFAULT_DATA, database: DatabaseOption = None) -> None:
    """List webhooks, newest first, and what is wrong with them."""
    with _visited(data, database) as connection:
        from stickslip_services.access.webhooks import list_webhooks

        found = list_webhooks(connection, time.time())
    shown = table("webhook", "url", "made", "failed tries", "fault", no_wrap=("webhook",))
    for webhook in found:
        fault = f"given up: {webhook.fault}" if webhook.is_given_up else webhook.fault
        made = f"{webhook.created_at:%Y-%m-%d %H:%M}"
        shown.add_row(webhook.id, escape(webhook.url), made, str(webhook.failures), escape(fault))
    console().print(shown)


@app.command()
@shows_errors
def retry(webhook: IdArgument, data: DataOption = DEFAULT_DATA, database: DatabaseOption = None) -> None:
    """Try again at once, also where the receiver was given up. Nothing that happened meanwhile is left out."""
    with _visited(data, database) as connection:
        from stickslip_services.access.webhooks import retry_webhook

        retry_webhook(connection, webhook, time.time())
    typer.echo(f"{webhook} is tried again")


@app.command()
@shows_errors
def delete(webhook: IdArgument, data: DataOption = DEFAULT_DATA, database: DatabaseOption = None) -> None:
    """Tell a receiver nothing any more."""
    with _visited(data, database) as connection:
        from stickslip_services.access.webhooks import delete_webhook

        delete_webhook(connection, webhook, time.time())
    typer.echo(f"{webhook} is deleted")
