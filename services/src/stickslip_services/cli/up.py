"""Running a coordinator and a dispatcher on this machine."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from stickslip_services.addresses import DEFAULT_PORT, DEFAULT_URL
from stickslip_services.cli.common import console
from stickslip_services.cli.errors import shows_errors
from stickslip_services.client.http import ClientError

_SERVER_MODULES = ("alembic", "fastapi", "jinja2", "prometheus_client", "pydantic_settings", "sqlalchemy", "uvicorn")


class ServerNotInstalledError(ClientError):
    """A server command was called where only the client is installed."""


def require_server(command: str) -> None:
    """Raise ServerNotInstalledError where the packages of the server are missing."""
    missing = [name for name in _SERVER_MODULES if find_spec(name) is None]
    if missing:
        raise ServerNotInstalledError(
            f"`stickslip {command}` needs the server, and {', '.join(missing)} is not installed: "
            "pip install 'stickslip-services[server]'"
        )


def _url_option(url: str) -> str:
    return "" if url == DEFAULT_URL else f" --url {url}"


@shows_errors
def up(
    data: Annotated[Path, typer.Option(help="directory of everything: database, store, logs")] = Path("stickslip-data"),
    port: Annotated[int, typer.Option(min=0, max=65535, help="port to listen on; 0: any free one")] = DEFAULT_PORT,
    host: Annotated[str, typer.Option(help="address to listen on; this version knows loopback only")] = "127.0.0.1",
    slots: Annotated[int | None, typer.Option(min=1, help="tasks at once; as many as there are cores")] = None,
    dispatcher: Annotated[str | None, typer.Option(hidden=True, help="another dispatcher, for tests")] = None,
) -> None:
    """Run a coordinator and a dispatcher with their workers on this machine, until Ctrl-C."""
    require_server("up")
    from stickslip_services.local import supervisor  # it starts a server, and its settings need the server's packages

    screen = console()
    status = supervisor.run(
        supervisor.LocalService(data=data, host=host, port=port, slots=slots, dispatcher=dispatcher),
        on_ready=lambda url: screen.print(
            f"stickslip is up. Dashboard: [bold]{url}[/]\n"
            f"To submit a job from another terminal: stickslip submit SPEC.yaml --watch{_url_option(url)}\n"
            f"Data are in {escape(str(data))}, logs in {escape(str(data / 'logs'))}. "
            "Ctrl-C stops the service; jobs go on when you start it again."
        ),
    )
    raise typer.Exit(status)
