"""Administration of a coordinator on its own machine: API keys, projects, webhooks and the audit log.

These commands open the database of a data directory, also while the coordinator runs. They need no API key: users who
may write the data directory may make keys.
"""

import json
import time
from typing import Annotated

import typer
from rich.markup import escape

from stickslip_services.access import audit_log as audit
from stickslip_services.access import keys as stored_keys
from stickslip_services.access import projects as stored_projects
from stickslip_services.access import webhooks as stored_webhooks
from stickslip_services.access.scopes import Scope
from stickslip_services.cli.common import DEFAULT_DATA, DatabaseOption, DataOption, console, say, table
from stickslip_services.cli.errors import shows_errors
from stickslip_services.client.errors import ClientError
from stickslip_services.settings import Settings

keys = typer.Typer(help="Make, list and revoke API keys.", no_args_is_help=True)
projects = typer.Typer(help="List projects, and set their quotas.", no_args_is_help=True)
webhooks = typer.Typer(help="Send job events to other programs.", no_args_is_help=True)

WebhookArgument = Annotated[str, typer.Argument(metavar="WEBHOOK", help="id, as `stickslip webhooks list` shows it")]


# --- keys -----------------------------------------------------------------------------------------------------


@keys.command("create")
@shows_errors
def create_key(
    name: Annotated[str, typer.Argument(help="owner or purpose of the key")],
    scope: Annotated[list[Scope], typer.Option(help="repeatable; `submit` includes `read`, `admin` includes all")],
    project: Annotated[
        str, typer.Option(help="project of the jobs that it submits: projects share leases, and may have quotas")
    ] = "",
    data: DataOption = DEFAULT_DATA,
    database: DatabaseOption = None,
) -> None:
    """Make a key and print it. It is shown only once, because the database keeps only its digest."""
    with audit.visited(data, database) as connection:
        key, secret = stored_keys.create_key(connection, name, scope, time.time(), project=project)
    typer.echo(secret)
    say(f"{key.id} is made. Keep the key: it cannot be shown again. Use it as STICKSLIP_KEY, or in the header")
    say("Authorization: Bearer KEY. Browsers send it as the password of any user name")


@keys.command("list")
@shows_errors
def list_keys(data: DataOption = DEFAULT_DATA, database: DatabaseOption = None) -> None:
    """List all keys, newest first, including revoked ones."""
    with audit.visited(data, database) as connection:
        found = stored_keys.list_keys(connection)
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


@keys.command("revoke")
@shows_errors
def revoke_key(
    key_id: Annotated[str, typer.Argument(metavar="KEY", help="id of a key, as `stickslip keys list` shows it")],
    data: DataOption = DEFAULT_DATA,
    database: DatabaseOption = None,
) -> None:
    """Revoke a key. A running coordinator refuses it within a second."""
    with audit.visited(data, database) as connection:
        stored_keys.revoke_key(connection, key_id, time.time())
    typer.echo(f"{key_id} is revoked")


# --- projects -------------------------------------------------------------------------------------------------


@projects.command("list")
@shows_errors
def list_projects(data: DataOption = DEFAULT_DATA, database: DatabaseOption = None) -> None:
    """List projects with their quotas, and the jobs and samples in progress that count against them."""
    with audit.visited(data, database) as connection:
        found = stored_projects.list_projects(connection)
    shown = table("project", "jobs", "at most", "samples", "at most", no_wrap=("project",))
    for project in found:
        limits = _limit(project.max_jobs), _limit(project.max_samples)
        shown.add_row(project.name or "(none)", f"{project.jobs:,}", limits[0], f"{project.samples:,}", limits[1])
    console().print(shown)


@projects.command("quota")
@shows_errors
def set_quota(
    name: Annotated[str, typer.Argument(metavar="PROJECT", help="'' for requests without a project")],
    samples: Annotated[int | None, typer.Option(min=0, help="most samples of jobs in progress; default: any")] = None,
    jobs: Annotated[int | None, typer.Option(min=0, help="most jobs in progress; default: any number")] = None,
    data: DataOption = DEFAULT_DATA,
    database: DatabaseOption = None,
) -> None:
    """Set the quota of a project from its next submission on. Submitted jobs are not affected."""
    with audit.visited(data, database) as connection:
        try:
            stored_projects.set_quota(connection, name, max_samples=samples, max_jobs=jobs, now=time.time())
        except ValueError as error:
            raise ClientError(str(error)) from None
    whose = f"the project {name}" if name else "requests without a project"
    console().print(f"{whose}: at most {_limit(jobs)} jobs and {_limit(samples)} samples that have not ended")


def _limit(value: int | None) -> str:
    return "any number" if value is None else f"{value:,}"


# --- webhooks -------------------------------------------------------------------------------------------------


@webhooks.command("create")
@shows_errors
def create_webhook(
    url: Annotated[str, typer.Argument(help="receiver of the events: https://..., or http:// on this machine")],
    project: Annotated[str, typer.Option(help="project whose jobs it hears of; default: jobs without one")] = "",
    data: DataOption = DEFAULT_DATA,
    database: DatabaseOption = None,
) -> None:
    """Make a webhook for events from now on, and print the secret that verifies its signatures."""
    with audit.visited(data, database) as connection:
        sealing = stored_keys.sealer(Settings.chosen(data=data))
        webhook, secret = stored_webhooks.create_webhook(connection, sealing, url, time.time(), project=project)
    typer.echo(secret)
    say(f"{webhook.id} is made. The receiver verifies messages with the secret, as standardwebhooks.com describes")


@webhooks.command("list")
@shows_errors
def list_webhooks(data: DataOption = DEFAULT_DATA, database: DatabaseOption = None) -> None:
    """List webhooks, newest first, with their faults."""
    with audit.visited(data, database) as connection:
        found = stored_webhooks.list_webhooks(connection, time.time())
    shown = table("webhook", "project", "url", "made", "failed tries", "fault", no_wrap=("webhook",))
    for webhook in found:
        fault = f"given up: {webhook.fault}" if webhook.is_given_up else webhook.fault
        made = f"{webhook.created_at:%Y-%m-%d %H:%M}"
        shown.add_row(webhook.id, webhook.project, escape(webhook.url), made, str(webhook.failures), escape(fault))
    console().print(shown)


@webhooks.command("retry")
@shows_errors
def retry_webhook(webhook: WebhookArgument, data: DataOption = DEFAULT_DATA, database: DatabaseOption = None) -> None:
    """Send again at once, also after the webhook was given up. No event since then is left out."""
    with audit.visited(data, database) as connection:
        stored_webhooks.retry_webhook(connection, webhook, time.time())
    typer.echo(f"{webhook} is tried again")


@webhooks.command("delete")
@shows_errors
def delete_webhook(webhook: WebhookArgument, data: DataOption = DEFAULT_DATA, database: DatabaseOption = None) -> None:
    """Delete a webhook."""
    with audit.visited(data, database) as connection:
        stored_webhooks.delete_webhook(connection, webhook, time.time())
    typer.echo(f"{webhook} is deleted")


# --- audit log ------------------------------------------------------------------------------------------------


@shows_errors
def audit_log(
    subject: Annotated[
        str | None, typer.Argument(metavar="ID", help="only changes of this job, version, key or webhook")
    ] = None,
    data: DataOption = DEFAULT_DATA,
    database: DatabaseOption = None,
    limit: Annotated[int, typer.Option(min=1, help="most entries to show")] = 100,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON document a line, for programs")] = False,
) -> None:
    """Show who changed what and when, newest first."""
    with audit.visited(data, database) as connection:
        entries = audit.read_audit_log(connection, subject=subject, limit=limit)
    if as_json:
        for entry in entries:
            document = {"at": entry.at.isoformat(), "actor": entry.actor, "action": entry.action}
            typer.echo(json.dumps(document | {"subject": entry.subject, "details": entry.details}))
        return
    shown = table("when", "who", "what", "to what", "details", no_wrap=("when", "what", "to what"))
    for entry in entries:
        details = ", ".join(f"{name} {value}" for name, value in entry.details.items())
        when = f"{entry.at:%Y-%m-%d %H:%M:%S}"
        shown.add_row(when, escape(entry.actor), entry.action, entry.subject, escape(details))
    console().print(shown)
