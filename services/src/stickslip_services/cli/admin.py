"""Commands that run a service on this machine, and administer it.

They manage API keys, projects, webhooks and the audit log.

The commands of administration open the database of a data directory, also while the coordinator
runs. They need no API key: users who may write the data directory may make keys.
"""

import functools
import re
import time
from collections.abc import Callable
from socket import gethostname

import click
from click.exceptions import Exit
from sqlalchemy import Connection
from stickslip_schemas.transport.addresses import API_KEY_VARIABLE, DEFAULT_URL

from stickslip_services.access import audit_log as stored_audit_log
from stickslip_services.access import keys as stored_keys
from stickslip_services.access import quotas as stored_quotas
from stickslip_services.access import webhooks as stored_webhooks
from stickslip_services.access.keys import command_transaction
from stickslip_services.access.principals import Scope
from stickslip_services.cli.common import CommandGroup, amount, shows_errors
from stickslip_services.cli.output import print_json_line, print_table, say, tell
from stickslip_services.database.database import Role, as_datetime
from stickslip_services.database.opening import check
from stickslip_services.local import supervisor
from stickslip_services.settings import SERVER, Settings, options

NAME_LETTERS = 63
"""Most letters of the name of a dispatcher."""

HOUR_SECONDS = 3600.0
DAY_SECONDS = 24 * HOUR_SECONDS

MAX_DAYS = 36_500
"""Longest lifetime of a key [d]: dates beyond the year 9999 cannot be written."""

_KEEP_KEY = (
    f"Keep the key: it cannot be shown again. Use it as {API_KEY_VARIABLE}, or in the header "
    "Authorization: Bearer KEY. Browsers send it as the password of any user name"
)


@click.command()
@click.option(
    "--name",
    help="name of the dispatcher; `local`, or this machine's where the database is PostgreSQL",
)
@click.option("--slots", type=click.IntRange(1), help="tasks at once; as many as there are cores")
@click.option("--workers", hidden=True, help="another program than stickslip_workers, for tests")
@shows_errors
@options(*SERVER)
def up(settings: Settings, name: str | None, slots: int | None, workers: str | None) -> None:
    """Run a coordinator, a Ray and a dispatcher on this machine, until Ctrl-C."""
    # Processes that are started in other folders must find the same data.
    data = settings.data
    settings = settings.model_copy(update={"data": data.absolute()})
    check(settings, Role.coordinator, with_store=True)

    def announce(url: str) -> None:
        option = "" if url == DEFAULT_URL else f" --url {url}"
        tell(
            f"stickslip is up. Dashboard: {url}\n"
            f"To submit a job from another terminal: stickslip submit SPEC.yaml --watch{option}\n"
            f"Data are in {data}, logs in {data / 'logs'}. Ctrl-C stops the service; jobs go on "
            "when you start it again."
        )

    status = supervisor.run(
        settings,
        name=name or _dispatcher_name(settings),
        slots=slots,
        workers=workers,
        on_ready=announce,
    )
    raise Exit(status)


def _dispatcher_name(settings: Settings) -> str:
    """Return the name of this machine's dispatcher.

    Machines that share a database need different ones: a second dispatcher of one name would take
    over the tasks of the first.
    """
    if settings.database is None:
        return "local"
    machine = re.sub(r"[^A-Za-z0-9_.-]", "-", gethostname())
    return machine.lstrip("_.-")[:NAME_LETTERS]


webhook_argument = click.argument("webhook", help="id, as `stickslip webhooks list` shows it")


def administers(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command a write transaction on a coordinator's database, and show its errors."""

    @functools.wraps(command)
    def run(settings: Settings, **arguments: object) -> None:
        with command_transaction(settings) as connection:
            command(connection, **arguments)

    return shows_errors(options("data", "database")(run))


@click.group(cls=CommandGroup)
def keys() -> None:
    """Make, list, rotate and revoke API keys."""


def lifetime_option(default: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return the option of the lifetime of a new key."""
    return click.option(
        "--days",
        type=amount("days", 0.01, MAX_DAYS),
        metavar="DAYS",
        help=f"the key expires after so many days; default: {default}",
    )


@keys.command("create")
@click.argument("name", help="owner or purpose of the key")
@click.option(
    "--scope",
    type=click.Choice(Scope),
    multiple=True,
    required=True,
    help="repeatable; `submit` includes `read`, `admin` includes all",
)
@click.option(
    "--project",
    default="",
    help="project of the jobs that it submits: projects share leases, and may have quotas",
)
@lifetime_option("never")
@administers
def create_key(
    connection: Connection,
    name: str,
    scope: tuple[Scope, ...],
    project: str,
    days: float | None,
) -> None:
    """Make a key and print it, once: the database keeps only its digest."""
    now = time.time()
    expires_at = None if days is None else now + DAY_SECONDS * days
    key_id, secret = stored_keys.create_key(
        connection, name, scope, now, project=project, expires_at=expires_at
    )
    # Only the secret goes to standard output: `key=$(stickslip keys create ...)`.
    click.echo(secret)
    say(f"{key_id} is made{_until(expires_at)}. {_KEEP_KEY}")


def _until(expires_at: float | None) -> str:
    return "" if expires_at is None else f", and expires at {_minute(expires_at)} UTC"


@keys.command("rotate")
@click.argument("key_id", metavar="KEY", help="id of a key, as `stickslip keys list` shows it")
@click.option(
    "--overlap",
    type=amount("hours", 0.0, 24 * MAX_DAYS),
    metavar="HOURS",
    default=24.0,
    help="the old key stays valid for so long",
)
@lifetime_option("as many as the old key")
@shows_errors
@options("data", "database")
def rotate_key(settings: Settings, key_id: str, overlap: float, days: float | None) -> None:
    """Make the successor of a key and print it, once. Both are valid during the overlap.

    The successor of the workers' key is also written to the file `worker-key` of the data
    directory. A worker reads its file again when its key is refused.
    """
    lifetime = None if days is None else DAY_SECONDS * days
    with command_transaction(settings) as connection:
        rotation = stored_keys.rotate_key(
            connection, key_id, time.time(), overlap=HOUR_SECONDS * overlap, lifetime=lifetime
        )
    # The database comes first: with the new file alone, workers would be refused.
    is_worker = stored_keys.replace_worker_key(settings.worker_key_path, rotation)
    click.echo(rotation.secret)
    say(
        f"{rotation.key_id} is made{_until(rotation.expires_at)}, and {key_id} expires at "
        f"{_minute(rotation.old_expires_at)} UTC. {_KEEP_KEY}"
    )
    if is_worker:
        say(f"{settings.worker_key_path} has the new key: copy it to workers on other machines")


@keys.command("list")
@administers
def list_keys(connection: Connection) -> None:
    """List all keys, newest first, including revoked and expired ones. Times are in UTC."""
    rows = []
    for key in stored_keys.list_keys(connection):
        revoked_at = "" if key.revoked_at is None else _minute(key.revoked_at)
        expires_at = "never" if key.expires_at is None else _minute(key.expires_at)
        scopes = key.scopes.replace(" ", ", ")
        created_at = _minute(key.created_at)
        rows.append((key.id, key.name, expires_at, revoked_at, scopes, key.project, created_at))
    print_table(("key", "name", "expires", "revoked", "scopes", "project", "made"), rows)


def _minute(seconds: float) -> str:
    """Return a time since 1970 [s] as a date and a time of day."""
    return f"{as_datetime(seconds):%Y-%m-%d %H:%M}"


@keys.command("revoke")
@click.argument("key_id", metavar="KEY", help="id of a key, as `stickslip keys list` shows it")
@administers
def revoke_key(connection: Connection, key_id: str) -> None:
    """Revoke a key. A running coordinator refuses it within a second."""
    stored_keys.revoke_key(connection, key_id, time.time())
    click.echo(f"{key_id} is revoked")


@click.group(cls=CommandGroup)
def projects() -> None:
    """List projects, and set their quotas."""


@projects.command("list")
@administers
def list_projects(connection: Connection) -> None:
    """List projects with their quotas, and the jobs and samples that count against them."""
    rows = []
    # Each quota stands beside the number that it limits.
    for project in stored_quotas.list_projects(connection):
        rows.append(
            (
                project.name or "(none)",
                f"{project.jobs:,}",
                _limit(project.max_jobs),
                f"{project.samples:,}",
                _limit(project.max_samples),
            )
        )
    print_table(("project", "jobs", "at most", "samples", "at most"), rows)


@projects.command("quota")
@click.argument("name", metavar="PROJECT", help="'' for requests without a project")
@click.option(
    "--samples",
    type=click.IntRange(0),
    help="most samples of jobs in progress; default: any number",
)
@click.option("--jobs", type=click.IntRange(0), help="most jobs in progress; default: any number")
@administers
def set_quota(connection: Connection, name: str, samples: int | None, jobs: int | None) -> None:
    """Set the quota of a project from its next submission on. Submitted jobs are not affected."""
    stored_quotas.set_quota(connection, name, max_samples=samples, max_jobs=jobs, now=time.time())
    whose = f"the project {name}" if name else "requests without a project"
    tell(f"{whose}: at most {_limit(jobs)} jobs and {_limit(samples)} samples that have not ended")


def _limit(value: int | None) -> str:
    return "any number" if value is None else f"{value:,}"


@click.group(cls=CommandGroup)
def webhooks() -> None:
    """Send job events to other programs."""


@webhooks.command("create")
@click.argument("url", help="receiver of the events: https://HOST/PATH, or http:// on this machine")
@click.option(
    "--project", default="", help="project whose jobs it hears of; default: jobs without one"
)
@shows_errors
@options("data", "database")
def create_webhook(settings: Settings, url: str, project: str) -> None:
    """Make a webhook for events from now on, and print the secret that verifies its signatures."""
    with command_transaction(settings) as connection:
        sealing = stored_keys.sealer(settings)
        webhook_id, secret = stored_webhooks.create_webhook(
            connection, sealing, url, time.time(), project=project
        )
    # Only the secret goes to standard output, as that of a key.
    click.echo(secret)
    say(
        f"{webhook_id} is made. The receiver verifies messages with the secret, as "
        "standardwebhooks.com describes"
    )


@webhooks.command("list")
@administers
def list_webhooks(connection: Connection) -> None:
    """List webhooks, newest first, with their faults."""
    rows = []
    for webhook in stored_webhooks.list_webhooks(connection, time.time()):
        fault = f"given up: {webhook.fault}" if webhook.is_given_up else webhook.fault
        failures = str(webhook.failures)
        created_at = _minute(webhook.created_at)
        rows.append((webhook.id, webhook.url, failures, webhook.project, created_at, fault))
    print_table(
        ("webhook", "url", "failed tries", "project", "made", "fault"), rows, sentences=True
    )


@webhooks.command("retry")
@webhook_argument
@administers
def retry_webhook(connection: Connection, webhook: str) -> None:
    """Send again at once, also after the webhook was given up. No event since then is left out."""
    stored_webhooks.retry_webhook(connection, webhook, time.time())
    click.echo(f"{webhook} is tried again")


@webhooks.command("delete")
@webhook_argument
@administers
def delete_webhook(connection: Connection, webhook: str) -> None:
    """Delete a webhook."""
    stored_webhooks.delete_webhook(connection, webhook, time.time())
    click.echo(f"{webhook} is deleted")


@click.command()
@click.argument(
    "subject",
    metavar="[ID]",
    required=False,
    help="only changes of this job, version, key or webhook",
)
@click.option("--limit", type=click.IntRange(1), default=100, help="most entries to show")
@click.option(
    "--json", "as_json", is_flag=True, help="print one JSON document a line, for programs"
)
@administers
def audit_log(connection: Connection, subject: str | None, limit: int, as_json: bool) -> None:
    """Show who changed what and when, newest first."""
    entries = stored_audit_log.read(connection, subject=subject, limit=limit)
    if as_json:
        for entry in entries:
            print_json_line(entry.model_dump(mode="json"))
        return
    rows = []
    for entry in entries:
        details = ", ".join(f"{name} {value}" for name, value in entry.details.items())
        moment = f"{entry.at:%Y-%m-%d %H:%M:%S}"
        rows.append((moment, entry.actor, entry.action, entry.subject, details))
    print_table(("when", "who", "what", "to what", "details"), rows, sentences=True)
