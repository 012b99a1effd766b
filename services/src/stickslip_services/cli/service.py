"""Commands for the service: run it on this machine, and list its workers."""

import re
from datetime import UTC, datetime
from pathlib import Path
from socket import gethostname
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from stickslip_services.addresses import DEFAULT_PORT, DEFAULT_URL
from stickslip_services.cli.common import (
    DEFAULT_DATA,
    DatabaseOption,
    JsonOption,
    StoreOption,
    UrlOption,
    console,
    print_json,
    require_server,
    table,
)
from stickslip_services.cli.errors import shows_errors
from stickslip_services.client.http import Client
from stickslip_services.units import duration

if TYPE_CHECKING:
    from stickslip_services.settings import Settings


def _url_option(url: str) -> str:
    return "" if url == DEFAULT_URL else f" --url {url}"


def _name(settings: "Settings") -> str:
    """Return a unique name for the dispatcher: a second one of the same name would take over its tasks."""
    return "local" if settings.database is None else re.sub(r"[^A-Za-z0-9_.-]", "-", gethostname()).lstrip("_.-")[:63]


@shows_errors
def up(
    data: Annotated[Path, typer.Option(help="directory of everything: database, store, logs")] = DEFAULT_DATA,
    port: Annotated[int, typer.Option(min=0, max=65535, help="port to listen on; 0: any free one")] = DEFAULT_PORT,
    host: Annotated[
        str, typer.Option(help="address to listen on; off loopback only with keys, and with TLS or behind a proxy")
    ] = "127.0.0.1",
    store: StoreOption = None,
    database: DatabaseOption = None,
    name: Annotated[
        str | None,
        typer.Option(help="name of the dispatcher; `local`, or this machine's where the database is PostgreSQL"),
    ] = None,
    slots: Annotated[int | None, typer.Option(min=1, help="tasks at once; as many as there are cores")] = None,
    allow_host: Annotated[
        list[str] | None, typer.Option(help="name that the coordinator may be asked by; repeatable")
    ] = None,
    require_keys: Annotated[bool, typer.Option("--require-keys", help="refuse every request without a key")] = False,
    behind_proxy: Annotated[
        bool, typer.Option("--behind-proxy", help="a proxy in front speaks TLS to the world; requests need keys")
    ] = False,
    tls_certificate: Annotated[Path | None, typer.Option(help="file with the certificate and its chain")] = None,
    tls_key: Annotated[Path | None, typer.Option(help="file with the private key of the certificate")] = None,
    signing_key: Annotated[
        Path | None, typer.Option(help="file with the key of OpenSSH that signs new versions")
    ] = None,
    workers: Annotated[
        str | None, typer.Option("--workers", hidden=True, help="another program than stickslip_workers, for tests")
    ] = None,
) -> None:
    """Run a coordinator, a Ray and a dispatcher on this machine, until Ctrl-C."""
    require_server()
    from stickslip_services.database.database import Role  # the server's packages may be missing
    from stickslip_services.database.opening import check
    from stickslip_services.local import supervisor
    from stickslip_services.settings import Settings

    screen = console()
    auth = {
        "allowed_hosts": tuple(allow_host or ()),
        "require_keys": require_keys,
        "behind_proxy": behind_proxy,
    }
    given: dict[str, Any] = {name: value for name, value in auth.items() if value}
    files = {"tls_certificate": tls_certificate, "tls_key": tls_key, "signing_key": signing_key}
    given |= {name: path.absolute() for name, path in files.items() if path is not None}
    given |= {name: value for name, value in (("store", store), ("database", database)) if value is not None}
    settings = Settings.chosen(data=data.absolute(), host=host, port=port, **given)
    check(settings, Role.coordinator, with_store=True)
    status = supervisor.run(
        supervisor.LocalService(settings, name or _name(settings), slots, workers),
        on_ready=lambda url: screen.print(
            f"stickslip is up. Dashboard: [bold]{url}[/]\n"
            f"To submit a job from another terminal: stickslip submit SPEC.yaml --watch{_url_option(url)}\n"
            f"Data are in {escape(str(data))}, logs in {escape(str(data / 'logs'))}. "
            "Ctrl-C stops the service; jobs go on when you start it again."
        ),
    )
    raise typer.Exit(status)


@shows_errors
def workers(url: UrlOption = DEFAULT_URL, as_json: JsonOption = False) -> None:
    """List the registered workers, newest first."""
    with Client(url) as client:
        found = client.workers()
    if as_json:
        return print_json(found)
    shown = table("worker", "kinds", "state", "slots", "tasks", "last seen", no_wrap=("worker",))
    now = datetime.now(UTC)
    for worker in found:
        ago = duration(max(0.0, (now - worker.last_seen_at).total_seconds()))
        shown.add_row(
            worker.name,
            ", ".join(worker.builds),
            worker.condition.state,
            str(worker.condition.slots),
            str(worker.leased),
            f"{ago} ago" if worker.alive else f"[red]{ago} ago: not connected[/]",
        )
    console().print(shown)
    for worker in found:
        if worker.condition.reason:
            console().print(f"{escape(worker.name)}: {escape(worker.condition.reason)}", soft_wrap=True)
    return None
