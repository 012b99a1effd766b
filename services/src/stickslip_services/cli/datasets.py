"""Commands for datasets: list, pull, export, sign and verify."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn, TransferSpeedColumn
from stickslip_schemas.format.manifest import SIGNATURE_NAME
from stickslip_schemas.format.selection import Selection

from stickslip_services.addresses import DEFAULT_URL, coordinator_url
from stickslip_services.cli.common import JsonOption, UrlOption, console, print_json, say, table
from stickslip_services.cli.errors import shows_errors
from stickslip_services.client.errors import ClientError
from stickslip_services.client.http import Client
from stickslip_services.client.pulling import pull
from stickslip_services.client.signing import sign_directory, signer_of
from stickslip_services.client.verifying import verify as find_faults
from stickslip_services.units import size

ArraysOption = Annotated[
    str | None, typer.Option(help="arrays to take, with commas between; labels always come; without, all")
]
SplitOption = Annotated[str | None, typer.Option(help="train, validation or test; without, all")]
WhereOption = Annotated[
    list[str] | None, typer.Option(help="a condition on a label, as in 'mu<0.5' or 'material==denim'; may repeat")
]

AllowedSignersOption = Annotated[
    Path | None, typer.Option(help="refuse a dataset that nobody of this file of ssh-keygen(1) has signed")
]

datasets = typer.Typer(help="List datasets and their versions, newest first.")


@datasets.callback(invoke_without_command=True)
@shows_errors
def _list(context: typer.Context, url: UrlOption = DEFAULT_URL, as_json: JsonOption = False) -> None:
    if context.invoked_subcommand is not None:
        return None
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
                size(version.bytes),
                f"{version.created_at:%Y-%m-%d %H:%M} UTC",
            )
    return console().print(shown)


@shows_errors
def pull_dataset(
    dataset: Annotated[str, typer.Argument(metavar="DATASET[:vN]", help="without :vN, the newest version")],
    target: Annotated[Path, typer.Argument(metavar="DEST", help="directory to write to")],
    arrays: ArraysOption = None,
    split: SplitOption = None,
    where: WhereOption = None,
    allowed_signers: AllowedSignersOption = None,
    url: UrlOption = DEFAULT_URL,
) -> None:
    """Download a dataset or a part of it. Every file is checked, and intact files are not downloaded again.

    A part has all labels and, of the other arrays, the shards that hold a chosen sample. The reader of
    stickslip-training shows only the chosen samples; other readers show fill values for missing samples.
    """
    screen = console()
    try:
        selection = Selection.of_options(arrays, split, where)
    except ValueError as error:
        raise ClientError(str(error)) from error
    with Client(url) as client:
        name, version = _resolve(client, dataset)
        columns = (BarColumn(bar_width=32), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
        with Progress(*columns, console=screen, disable=not screen.is_terminal) as bar:
            row = bar.add_task("pull", total=None)
            done = pull(
                client,
                name,
                version,
                target,
                selection=selection,
                allowed_signers=allowed_signers,
                on_plan=lambda _files, count: bar.update(row, total=count),
                on_bytes=lambda count: bar.advance(row, count),
            )
    there = done.files - done.downloaded_files
    screen.print(
        f"{name}:v{version} is in {escape(str(target))}: {done.downloaded_files} files downloaded "
        f"({size(done.downloaded_bytes)}), {there} already there"
    )
    say(f"{target / 'README.md'} describes the dataset and how to read it. To check it: stickslip verify {target}")


@shows_errors
def export(context: typer.Context, url: UrlOption = DEFAULT_URL) -> None:
    """Export a dataset to a format of another library.

    Passes all arguments on to `stickslip-train export`. A DATASET[:vN] of the coordinator becomes the URL of a version.
    """
    if find_spec("stickslip_training") is None:
        raise ClientError("`stickslip export` needs the training package: pip install 'stickslip-training[export]'")
    arguments = [_version_url(argument, url) if _ID.match(argument) else argument for argument in context.args]
    key = os.environ.get("STICKSLIP_KEY")
    ended = subprocess.run(
        [sys.executable, "-m", "stickslip_training.cli", "export", *arguments],
        env=os.environ | ({"STICKSLIP_API_KEY": key} if key else {}),
        check=False,
    )
    raise typer.Exit(ended.returncode)


def _version_url(dataset: str, url: str) -> str:
    with Client(url) as client:
        name, version = _resolve(client, dataset)
    return f"{coordinator_url(url)}/v1/datasets/{name}/versions/{version}"


_ID = re.compile(r"ds-[0-9a-f]{16}(:|$)")


def _resolve(client: Client, dataset: str) -> tuple[str, int]:
    name, colon, version = dataset.partition(":v")
    if not colon:
        versions = client.dataset(name).versions
        if not versions:
            raise ClientError(f"dataset {name} has no version yet")
        return name, versions[-1].version
    if not version.isdecimal() or len(version) > 9:
        raise ClientError(f"must be DATASET:vN, as in ds-0123456789abcdef:v1, and is {dataset!r}")
    return name, int(version)


@shows_errors
def sign(
    target: Annotated[Path, typer.Argument(metavar="DIR", help="a dataset that was pulled, or a version in a store")],
    key: Annotated[Path, typer.Option(help="private key of OpenSSH, or a public key whose private one an agent has")],
) -> None:
    """Sign a dataset with a key of OpenSSH. The signature, manifest.sha256.sig, covers all of its files."""
    sign_directory(target, key)
    console().print(f"{escape(str(target / SIGNATURE_NAME))} is written")


@shows_errors
def verify(
    target: Annotated[Path, typer.Argument(metavar="DIR", help="a dataset that was pulled")],
    allowed_signers: AllowedSignersOption = None,
) -> None:
    """Check every file of a dataset against its manifest, and who signed it; exit with 1 if anything is wrong."""
    screen = console()
    signed = "" if allowed_signers is None else f", signed by {signer_of(target, allowed_signers)}"
    faults = find_faults(target)
    if not faults:
        screen.print(escape(f"{target}: all files are present and unchanged{signed}"))
        return
    shown = table("file", "fault", "detail")
    for fault in faults:
        shown.add_row(escape(fault.path), fault.fault, escape(fault.detail))
    screen.print(shown)
    files = "1 file is" if len(faults) == 1 else f"{len(faults)} files are"
    screen.print(
        f"{files} missing, damaged or not part of the dataset. To repair it, run `stickslip pull` again.", style="red"
    )
    raise typer.Exit(1)
