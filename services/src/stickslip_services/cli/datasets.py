"""Datasets: listing, pulling and verifying them."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn, TransferSpeedColumn

from stickslip_services.addresses import DEFAULT_URL
from stickslip_services.cli import wording
from stickslip_services.cli.common import JsonOption, UrlOption, console, print_json, say, table
from stickslip_services.cli.errors import shows_errors
from stickslip_services.client import pulling
from stickslip_services.client.http import Client, ClientError


@shows_errors
def datasets(url: UrlOption = DEFAULT_URL, as_json: JsonOption = False) -> None:
    """List datasets and their versions, newest first."""
    with Client(url) as client:
        found = list(client.datasets())
    if as_json:
        return print_json(found)
    shown = table("dataset", "name", "kind", "samples", "valid", "size", "made", no_wrap=("dataset",))
    for dataset in found:
        for version in dataset.versions:
            shown.add_row(
                f"{dataset.id}:v{version.version}",
                dataset.name or "",
                dataset.kind,
                str(version.sample_count),
                str(version.valid_count),
                wording.size(version.bytes),
                f"{version.created_at:%Y-%m-%d %H:%M} UTC",
            )
    return console().print(shown)


@shows_errors
def pull_dataset(
    dataset: Annotated[str, typer.Argument(metavar="DATASET[:vN]", help="without :vN, the newest version")],
    target: Annotated[Path, typer.Argument(metavar="DEST", help="directory to write to")],
    url: UrlOption = DEFAULT_URL,
) -> None:
    """Download a dataset. Every file is checked, and files that are already there are not downloaded again."""
    screen = console()
    with Client(url) as client:
        name, version = _resolve(client, dataset)
        columns = (BarColumn(bar_width=32), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
        with Progress(*columns, console=screen, disable=not screen.is_terminal) as bar:
            row = bar.add_task("pull", total=None)
            done = pulling.pull(
                client,
                name,
                version,
                target,
                on_plan=lambda _files, count: bar.update(row, total=count),
                on_bytes=lambda count: bar.advance(row, count),
            )
    there = done.files - done.downloaded_files
    screen.print(
        f"{name}:v{version} is in {escape(str(target))}: {done.downloaded_files} files downloaded "
        f"({wording.size(done.downloaded_bytes)}), {there} already there"
    )
    say(f"{target / 'README.md'} says what it holds and how to read it. To check it again: stickslip verify {target}")


def _resolve(client: Client, dataset: str) -> tuple[str, int]:
    name, colon, version = dataset.partition(":v")
    if not colon:
        versions = client.dataset(name).versions
        if not versions:
            raise ClientError(f"dataset {name} has no version yet")
        return name, versions[-1].version
    if not version.isdecimal() or len(version) > 9:
        raise ClientError(f"a version is written DATASET:v1, and this is {dataset!r}")
    return name, int(version)


@shows_errors
def verify(target: Annotated[Path, typer.Argument(metavar="DIR", help="a dataset that was pulled")]) -> None:
    """Check every file of a dataset against its manifest; exit with 1 if anything is wrong."""
    screen = console()
    faults = pulling.verify(target)
    if not faults:
        screen.print(f"{escape(str(target))}: every file is there, and no byte has changed")
        return
    shown = table("file", "fault", "detail")
    for fault in faults:
        shown.add_row(escape(fault.path), fault.fault, escape(fault.detail))
    screen.print(shown)
    files = "1 file is" if len(faults) == 1 else f"{len(faults)} files are"
    screen.print(
        f"{files} missing, damaged or not part of the dataset. To mend it, run `stickslip pull` again.", style="red"
    )
    raise typer.Exit(1)
