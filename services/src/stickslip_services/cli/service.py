"""Commands for the service: run it on this machine, and list its workers."""

import re
from datetime import UTC, datetime
from pathlib import Path
from socket import gethostname
from typing import TYPE_CHECKING, Any

import click
from click.exceptions import Exit

from stickslip_services.addresses import DEFAULT_PORT, DEFAULT_URL
from stickslip_services.cli.common import (
    DEFAULT_DATA,
    FILE,
    asks,
    database_option,
    json_option,
    print_json,
    print_table,
    require_server,
    shows_errors,
    store_option,
)
from stickslip_services.client.http import Client
from stickslip_services.units import duration

if TYPE_CHECKING:
    from stickslip_services.settings import Settings


def _name(settings: "Settings") -> str:
    """Return a unique name for the dispatcher: a second one of the same name would take over its tasks."""
    return "local" if settings.database is None else re.sub(r"[^A-Za-z0-9_.-]", "-", gethostname()).lstrip("_.-")[:63]


@click.command()
@click.option("--data", type=FILE, default=DEFAULT_DATA, help="directory of everything: database, store, logs")
@click.option("--port", type=click.IntRange(0, 65535), default=DEFAULT_PORT, help="port to listen on; 0: any free one")
@click.option(
    "--host",
    default="127.0.0.1",
    help="address to listen on; off loopback only with keys, and with TLS or behind a proxy",
)
@store_option
@database_option
@click.option("--name", help="name of the dispatcher; `local`, or this machine's where the database is PostgreSQL")
@click.option("--slots", type=click.IntRange(1), help="tasks at once; as many as there are cores")
@click.option("--allow-host", multiple=True, help="name that the coordinator may be asked by; repeatable")
@click.option("--require-keys", is_flag=True, help="refuse every request without a key")
@click.option("--behind-proxy", is_flag=True, help="a proxy in front speaks TLS to the world; requests need keys")
@click.option("--tls-certificate", type=FILE, help="file with the certificate and its chain")
@click.option("--tls-key", type=FILE, help="file with the private key of the certificate")
@click.option("--signing-key", type=FILE, help="file with the key of OpenSSH that signs new versions")
@click.option("--workers", hidden=True, help="another program than stickslip_workers, for tests")
@shows_errors
def up(
    data: Path,
    port: int,
    host: str,
    store: str | None,
    database: str | None,
    name: str | None,
    slots: int | None,
    allow_host: tuple[str, ...],
    require_keys: bool,
    behind_proxy: bool,
    workers: str | None,
    **files: Path | None,
) -> None:
    """Run a coordinator, a Ray and a dispatcher on this machine, until Ctrl-C."""
    require_server()
    from stickslip_services.database.database import Role  # the server's packages may be missing
    from stickslip_services.database.opening import check
    from stickslip_services.local import supervisor
    from stickslip_services.settings import Settings

    auth = {"allowed_hosts": allow_host, "require_keys": require_keys, "behind_proxy": behind_proxy}
    given: dict[str, Any] = {name: value or None for name, value in auth.items()}
    given |= {name: path and path.absolute() for name, path in files.items()}
    settings = Settings.chosen(data=data.absolute(), host=host, port=port, store=store, database=database, **given)
    check(settings, Role.coordinator, with_store=True)
    status = supervisor.run(
        supervisor.LocalService(settings, name or _name(settings), slots, workers),
        on_ready=lambda url: click.echo(
            f"stickslip is up. Dashboard: {click.style(url, bold=True)}\n"
            f"To submit a job from another terminal: stickslip submit SPEC.yaml --watch"
            f"{'' if url == DEFAULT_URL else f' --url {url}'}\n"
            f"Data are in {data}, logs in {data / 'logs'}. "
            "Ctrl-C stops the service; jobs go on when you start it again."
        ),
    )
    raise Exit(status)


@click.command()
@json_option
@asks
def workers(url: str, as_json: bool) -> None:
    """List the registered workers, newest first."""
    with Client(url) as client:
        found = client.workers()
    if as_json:
        return print_json(found)
    rows, now = [], datetime.now(UTC)
    for worker in found:
        ago = f"{duration(max(0.0, (now - worker.last_seen_at).total_seconds()))} ago"
        seen = ago if worker.alive else click.style(f"{ago}: not connected", fg="red")
        numbers = str(worker.condition.slots), str(worker.leased)
        rows.append((worker.name, worker.condition.state, *numbers, seen, ", ".join(worker.builds)))
    print_table(("worker", "state", "slots", "tasks", "last seen", "kinds"), rows)
    for worker in found:
        if worker.condition.reason:
            click.echo(f"{worker.name}: {worker.condition.reason}")
    return None
