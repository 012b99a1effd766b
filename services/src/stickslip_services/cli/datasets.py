"""Commands for datasets: list, pull, export, sign and verify."""

import re
import sys
from pathlib import Path
from threading import Lock
from typing import NamedTuple

import click
from click.exceptions import Exit
from stickslip_schemas.documents.responses import Dataset, DatasetVersion
from stickslip_schemas.format.manifest import SIGNATURE_NAME
from stickslip_schemas.format.selection import Selection
from stickslip_schemas.installation import install_hint
from stickslip_schemas.transport.addresses import URL_VARIABLE

from stickslip_services.cli.common import FILE, asks, json_option, shows_errors
from stickslip_services.cli.output import print_json, print_table, say, tell
from stickslip_services.cli.passed_on import PASSES_ARGUMENTS, Program, require_program, run_program
from stickslip_services.client import pulling
from stickslip_services.client.answers import printable
from stickslip_services.client.errors import ClientError, SelectionError
from stickslip_services.client.http import Client
from stickslip_services.client.signing import sign_directory, signer_of
from stickslip_services.client.verifying import READS_ARRAYS
from stickslip_services.client.verifying import verify as find_faults
from stickslip_services.units import size

DATASET_ID = re.compile(r"ds-[0-9a-f]{16}")
VERSION_DIGITS = 9
"""Most digits of the number of a version."""

allowed_signers_option = click.option(
    "--allowed-signers",
    type=FILE,
    help="refuse a dataset that nobody of this file of ssh-keygen(1) has signed",
)


class VersionName(NamedTuple):
    """A version of a dataset by its id and number."""

    dataset: str
    version: int

    def __str__(self) -> str:
        return f"{self.dataset}:v{self.version}"


@click.command()
@click.option("--latest", is_flag=True, help="print only the name of the newest version")
@json_option
@asks
def datasets(client: Client, latest: bool, as_json: bool) -> None:
    """List datasets and their versions, newest first.

    `stickslip pull "$(stickslip datasets --latest)" DEST` downloads the newest one.
    """
    # For scripts: only the name, which `pull` reads.
    if latest:
        newest = _newest(client)
        if as_json:
            print_json(newest)
        else:
            click.echo(VersionName(newest.id, newest.versions[-1].version))
        return
    all_datasets = list(client.datasets())
    if as_json:
        print_json(all_datasets)
        return
    rows = []
    for dataset in all_datasets:
        for version in dataset.versions:
            rows.append(_dataset_row(dataset, version))
    print_table(("dataset", "name", "samples", "valid", "size", "kind", "made"), rows)


def _newest(client: Client) -> Dataset:
    """Return the dataset whose newest version was published last."""
    published = [dataset for dataset in client.datasets() if dataset.versions]
    if not published:
        raise ClientError("there is no dataset yet: `stickslip submit` makes one")
    return max(published, key=lambda dataset: dataset.versions[-1].created_at)


def _dataset_row(dataset: Dataset, version: DatasetVersion) -> tuple[str, ...]:
    return (
        str(VersionName(dataset.id, version.version)),
        dataset.name or "",
        str(version.sample_count),
        str(version.valid_count),
        size(version.bytes),
        dataset.kind,
        f"{version.created_at:%Y-%m-%d %H:%M} UTC",
    )


@click.command()
@click.argument("dataset", metavar="DATASET[:vN]", help="id or name; without :vN, the newest")
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
    # A wrong option is refused before the coordinator is asked.
    try:
        selection = Selection.of_options(arrays, split, where)
    except ValueError as error:
        raise SelectionError(str(error)) from error
    # The version is fixed now: a newer one that is published meanwhile must not mix in.
    name = _resolve(client, dataset)
    lock = Lock()  # several threads download
    with click.progressbar(
        length=0, label="pull", hidden=not sys.stderr.isatty(), file=sys.stderr
    ) as bar:

        def on_bytes(count: int) -> None:
            with lock:
                bar.update(count)

        result = pulling.pull(
            client,
            name.dataset,
            name.version,
            target,
            selection=selection,
            allowed_signers=allowed_signers,
            on_plan=lambda _files, count: setattr(bar, "length", count),
            on_bytes=on_bytes,
        )
    samples = "1 sample" if result.samples == 1 else f"{result.samples} samples"
    tell(
        f"{name} is in {target}: {samples}, {result.downloaded_files} files downloaded "
        f"({size(result.downloaded_bytes)}), {result.files - result.downloaded_files} already there"
    )
    say(
        f"{target / 'README.md'} describes the dataset and how to read it. To check it: "
        f"stickslip verify {target}"
    )


_EXPORT = Program(
    command="export",
    package="training",
    distribution="stickslip-training",
    extra="export",
    module="stickslip_training.cli",
    words=("export",),
)


@click.command(context_settings=PASSES_ARGUMENTS)
@asks
def export(client: Client) -> None:
    """Export a dataset to a format of another library.

    Passes all arguments on to `stickslip-train export`. A DATASET[:vN] of the coordinator becomes
    the URL of a version.
    """
    require_program(_EXPORT)
    arguments = []
    for argument in click.get_current_context().args:
        if DATASET_ID.fullmatch(argument.partition(":")[0]):
            name = _resolve(client, argument)
            argument = f"{client.url}/v1/datasets/{name.dataset}/versions/{name.version}"
        arguments.append(argument)
    # The key belongs to this coordinator.
    run_program(_EXPORT, arguments, {URL_VARIABLE: client.url})


def _resolve(client: Client, text: str) -> VersionName:
    """Return the version that `DATASET` or `DATASET:vN` means, DATASET being an id or a name."""
    # Names of datasets have no colon, so the last one begins the version.
    dataset, colon, number = text.rpartition(":v")
    if not colon:
        dataset = text
    is_number = number.isascii() and number.isdecimal() and len(number) <= VERSION_DIGITS
    if colon and not is_number:
        raise ClientError(f"must be DATASET:vN, as in ds-0123456789abcdef:v1, and is {text!r}")
    if DATASET_ID.fullmatch(dataset) is None:
        dataset = client.find_dataset(dataset).id
    return VersionName(dataset, int(number) if colon else client.newest(dataset))


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
    tell(f"{target / SIGNATURE_NAME} is written")


@click.command()
@click.argument("target", metavar="DIR", type=FILE, help="a dataset that was pulled")
@allowed_signers_option
@shows_errors
def verify(target: Path, allowed_signers: Path | None) -> None:
    """Check every file of a dataset against its manifest, and who signed it.

    Exit with 1 if anything is wrong.
    """
    # The signature comes first: it takes milliseconds, and the files may take minutes.
    signer = "" if allowed_signers is None else printable(signer_of(target, allowed_signers))
    faults = find_faults(target)
    if not faults:
        signed = f", signed by {signer}" if signer else ""
        tell(f"{target}: all files are present and unchanged{signed}")
        if not READS_ARRAYS:
            say(
                "sample keys were not compared with the manifest, which needs more packages: "
                + install_hint("stickslip", "arrays")
            )
        return
    rows = [(fault.path, fault.fault, fault.detail) for fault in faults]
    print_table(("file", "fault", "detail"), rows, sentences=True)
    files = "1 file is" if len(faults) == 1 else f"{len(faults)} files are"
    tell(
        f"{files} missing, damaged or not part of the dataset. To repair it, run `stickslip pull` "
        "again."
    )
    raise Exit(1)
