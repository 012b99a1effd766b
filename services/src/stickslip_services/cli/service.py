"""The command that runs a service on this machine."""

import re
from socket import gethostname

import click
from click.exceptions import Exit

from stickslip_services.addresses import DEFAULT_URL
from stickslip_services.cli.common import shows_errors
from stickslip_services.database.database import Role
from stickslip_services.database.opening import check
from stickslip_services.local import supervisor
from stickslip_services.settings import SERVER, Settings, options


@click.command()
@click.option("--name", help="name of the dispatcher; `local`, or this machine's where the database is PostgreSQL")
@click.option("--slots", type=click.IntRange(1), help="tasks at once; as many as there are cores")
@click.option("--workers", hidden=True, help="another program than stickslip_workers, for tests")
@shows_errors
@options(*SERVER)
def up(settings: Settings, name: str | None, slots: int | None, workers: str | None) -> None:
    """Run a coordinator, a Ray and a dispatcher on this machine, until Ctrl-C."""
    data = settings.data
    settings = settings.model_copy(update={"data": data.absolute()})
    check(settings, Role.coordinator, with_store=True)
    if name is None:  # a second dispatcher of one name would take over its tasks
        own = re.sub(r"[^A-Za-z0-9_.-]", "-", gethostname()).lstrip("_.-")[:63]
        name = "local" if settings.database is None else own
    status = supervisor.run(
        settings,
        name=name,
        slots=slots,
        workers=workers,
        on_ready=lambda url: click.echo(
            f"stickslip is up. Dashboard: {click.style(url, bold=True)}\n"
            f"To submit a job from another terminal: stickslip submit SPEC.yaml --watch"
            f"{'' if url == DEFAULT_URL else f' --url {url}'}\n"
            f"Data are in {data}, logs in {data / 'logs'}. "
            "Ctrl-C stops the service; jobs go on when you start it again."
        ),
    )
    raise Exit(status)
