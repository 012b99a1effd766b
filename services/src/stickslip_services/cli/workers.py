"""The command that lists workers."""

from datetime import UTC, datetime

import click

from stickslip_services.cli.common import asks, json_option, print_json, print_table
from stickslip_services.client.http import Client
from stickslip_services.units import duration


@click.command()
@json_option
@asks
def workers(client: Client, as_json: bool) -> None:
    """List the registered workers, newest first."""
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
