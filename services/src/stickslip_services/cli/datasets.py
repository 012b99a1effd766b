"""Commands for datasets: list, pull, export, sign and verify."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from threading import Lock

import click
from click.exceptions import Exit
from stickslip_schemas.format.manifest import SIGNATURE_NAME
from stickslip_schemas.format.selection import Selection
from stickslip_schemas.installation import install_hint
from stickslip_schemas.transport.addresses import URL_VARIABLE

from stickslip_services.cli.common import (
    FILE,
    asks,
    json_option,
    print_json,
    print_table,
    say,
    shows_errors,
)
from stickslip_services.client import pulling
from stickslip_services.client.errors import ClientError
from stickslip_services.client.http import Client
from stickslip_services.client.signing import sign_directory, signer_of
from stickslip_services.client.verifying import READS_ARRAYS
from stickslip_services.client.verifying import verify as find_faults
from stickslip_services.units import size

allowed_signers_option = click.option(
    "--allowed-signers",
    type=FILE,
    help="refuse a dataset that nobody of this file of ssh-keygen(1) has signed",
)


@click.command()
@json_option
@asks
def datasets(client: Client, as_json: bool) -> None:
    """List datasets and their versions, newest first."""
    found = list(client.datasets())
    if as_json:
        return print_json(found)
    rows = []
    for dataset, version in ((each, version) for each in found for version in each.versions):
        name, made = f"{dataset.id}:v{version.version}", f"{version.created_at:%Y-%m-%d %H:%M} UTC"
        sizes = str(version.sample_count), str(version.valid_count), size(version.bytes)
        rows.append((name, dataset.name or "", *sizes, dataset.kind, made))
    return print_table(("dataset", "name", "samples", "valid", "size", "kind", "made"), rows)


@click.command()
@click.argument("dataset", metavar="DATASET[:vN]", help="without :vN, the newest version")
@click.argument("target", metavar="DEST", type=FILE, help="directory to write to")
@click.option(
    "--arrays", help="arrays to take, with commas between; labels always come; without, all"
)
@click.option("--split", help="train, validation or test; without, all")
@click.option(
    "--where",
    multiple=True,
    help="a condition on a label, as in 'mu<0.5' or 'material==denim'; may repeat",
)
@allowed_signers_option
@asks
def pull(
    client: Client,
    dataset: str,
    target: Path,
    arrays: str | None,
    split: str | None,
    where: tuple[str, ...],
    allowed_signers: Path | None,
) -> None:
    """Download a dataset or a part of it.

    Every file is checked, and intact files are not downloaded again.

    A part has all labels and, of the other arrays, the shards that hold a chosen sample. The reader
    of stickslip-training shows only the chosen samples; other readers show fill values for missing
    samples.
    """
    try:
        selection = Selection.of_options(arrays, split, where)
    except ValueError as error:
        raise ClientError(str(error)) from error
    name, version = _resolve(client, dataset)
    counting = Lock()  # files are downloaded by several threads
    with click.progressbar(
        length=0, label="pull", hidden=not sys.stderr.isatty(), file=sys.stderr
    ) as bar:

        def on_bytes(count: int) -> None:
            with counting:
                bar.update(count)

        done = pulling.pull(
            client,
            name,
            version,
            target,
            selection=selection,
            allowed_signers=allowed_signers,
            on_plan=lambda _files, count: setattr(bar, "length", count),
            on_bytes=on_bytes,
        )
    there = done.files - done.downloaded_files
    click.echo(
        f"{name}:v{version} is in {target}: {done.downloaded_files} files downloaded "
        f"({size(done.downloaded_bytes)}), {there} already there"
    )
    say(
        f"{target / 'README.md'} describes the dataset and how to read it. To check it: stickslip verify {target}"
    )


@click.command(
    context_settings={
        "allow_extra_args": True,
        "ignore_unknown_options": True,
        "help_option_names": [],
    }
)
@asks
def export(client: Client) -> None:
    """Export a dataset to a format of another library.

    Passes all arguments on to `stickslip-train export`. A DATASET[:vN] of the coordinator becomes
    the URL of a version.
    """
    if find_spec("stickslip_training") is None:
        raise ClientError(
            "`stickslip export` needs the training package: "
            + install_hint("stickslip-training", "export")
        )
    given = click.get_current_context().args
    arguments = []
    for argument in given:
        if re.match(r"ds-[0-9a-f]{16}(:|$)", argument):
            name, version = _resolve(client, argument)
            argument = f"{client.url}/v1/datasets/{name}/versions/{version}"
        arguments.append(argument)
    ended = subprocess.run(
        [sys.executable, "-m", "stickslip_training.cli", "export", *arguments],
        env=os.environ | {URL_VARIABLE: client.url},  # the key belongs to this coordinator
        check=False,
    )
    raise Exit(ended.returncode)


def _resolve(client: Client, dataset: str) -> tuple[str, int]:
    name, colon, version = dataset.partition(":v")
    if not colon:
        return name, client.newest(name)
    if not version.isdecimal() or len(version) > 9:
        raise ClientError(f"must be DATASET:vN, as in ds-0123456789abcdef:v1, and is {dataset!r}")
    return name, int(version)


@click.command()
@click.argument(
    "target", metavar="DIR", type=FILE, help="a dataset that was pulled, or a version in a store"
)
@click.option(
    "--key",
    type=FILE,
    required=True,
    help="private key of OpenSSH, or a public key whose private one an agent has",
)
@shows_errors
def sign(target: Path, key: Path) -> None:
    """Sign a dataset with a key of OpenSSH.

    The signature, manifest.sha256.sig, covers all of its files.
    """
    sign_directory(target, key)
    click.echo(f"{target / SIGNATURE_NAME} is written")


@click.command()
@click.argument("target", metavar="DIR", type=FILE, help="a dataset that was pulled")
@allowed_signers_option
@shows_errors
def verify(target: Path, allowed_signers: Path | None) -> None:
    """Check every file of a dataset against its manifest, and who signed it.

    Exit with 1 if anything is wrong.
    """
    signed = "" if allowed_signers is None else f", signed by {signer_of(target, allowed_signers)}"
    faults = find_faults(target)
    if not faults:
        click.echo(f"{target}: all files are present and unchanged{signed}")
        if not READS_ARRAYS:
            say(
                "sample keys were not compared with the manifest, which needs more packages: "
                + install_hint("stickslip", "arrays")
            )
        return
    print_table(
        ("file", "fault", "detail"),
        ((each.path, each.fault, each.detail) for each in faults),
        sentences=True,
    )
    files = "1 file is" if len(faults) == 1 else f"{len(faults)} files are"
    click.secho(
        f"{files} missing, damaged or not part of the dataset. To repair it, run `stickslip pull` again.",
        fg="red",
    )
    raise Exit(1)
