"""The command that lists workers."""

from datetime import UTC, datetime

from stickslip_services.addresses import DEFAULT_URL
from stickslip_services.cli.common import JsonOption, UrlOption, console, print_json, table
from stickslip_services.cli.errors import shows_errors
from stickslip_services.client.http import Client
from stickslip_services.units import duration


@shows_errors
def workers(url: UrlOption = DEFAULT_URL, as_json: JsonOption = False) -> None:
    """List the registered workers, newest first."""
    with Client(url) as client:
        found = client.workers()
    if as_json:
        return print_json(found)
    shown = table("worker", "kinds", "slots", "tasks", "last seen", no_wrap=("worker",))
    now = datetime.now(UTC)
    for worker in found:
        ago = duration(max(0.0, (now - worker.last_seen_at).total_seconds()))
        shown.add_row(
            worker.name,
            ", ".join(worker.builds),
            str(worker.slots),
            str(worker.leased),
            f"{ago} ago" if worker.alive else f"[red]{ago} ago: not connected[/]",
        )
    return console().print(shown)
