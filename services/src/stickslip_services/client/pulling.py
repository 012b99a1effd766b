"""Downloads of dataset versions to a directory.

The manifest lists the files and their digests. Only listed files are written, and none is larger
than the manifest states. The manifest itself is written last, so a directory with a manifest is
complete.
"""

import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from pydantic import ValidationError
from stickslip_schemas.base import sha256
from stickslip_schemas.format.manifest import (
    GROUP_NAME,
    MANIFEST_NAME,
    SEAL_NAME,
    SIGNATURE_NAME,
    BrokenSealError,
    BrokenSectionError,
    Contents,
    FileEntry,
    Manifest,
    check_seal,
    layout,
)
from stickslip_schemas.format.selection import SELECTION_NAME, PartDocument, Selection, part_files
from stickslip_schemas.store import write_durably

from stickslip_services.client.answers import parse
from stickslip_services.client.downloads import Downloader
from stickslip_services.client.errors import (
    ClientError,
    DamagedError,
    ForeignFilesError,
    ProblemError,
    SelectionError,
)
from stickslip_services.client.http import Client
from stickslip_services.client.signing import check_signature
from stickslip_services.client.verifying import (
    EVERYTHING,
    PART_SUFFIX,
    RESERVED_NAMES,
    check_counts,
    check_path,
    fault_of,
    files_below,
    read_label,
    read_part,
)

SIGNATURE_BYTES = 2**16
"""Largest signature that is read [bytes]; one of a key of 16,384 bits has 6 kB."""


@dataclass(frozen=True, slots=True)
class Pulled:
    """Counts of a finished pull; `files` includes the files that were already there."""

    samples: int
    """Valid samples of the version, or of the chosen part."""
    files: int
    downloaded_files: int
    downloaded_bytes: int


class _Sealed(NamedTuple):
    """A version whose seal holds."""

    contents: Contents
    files: dict[str, bytes]
    """The three files that vouch for all others, by name, the manifest last."""


class _Part(NamedTuple):
    """The files of a chosen part of a version."""

    files: list[FileEntry]
    samples: int
    """Chosen samples."""
    label_files: int
    """Files of labels that had to be downloaded to choose the samples."""
    label_bytes: int


def pull(
    client: Client,
    dataset: str,
    version: int,
    target: Path,
    *,
    selection: Selection = EVERYTHING,
    allowed_signers: Path | None = None,
    on_bytes: Callable[[int], None] = lambda _: None,
    on_plan: Callable[[int, int], None] = lambda _files, _bytes: None,
) -> Pulled:
    """Download a version, or the part that `selection` chooses, to `target`.

    Intact files are not downloaded again. A part has all labels and, of the other arrays, the
    shards that hold a chosen sample; `selection.json` describes it.

    Args:
        client: A client of the coordinator that has the dataset.
        dataset: Id of the dataset.
        version: Number of the version.
        target: Directory to write to.
        selection: Part to download.
        allowed_signers: File of the signers to trust [ssh-keygen(1)]; without it, signatures are
            not checked.
        on_bytes: Called with the number of bytes of each received block.
        on_plan: Called once, with the number of files and bytes to download.

    Raises:
        ForeignFilesError: `target` holds other files. Nothing was written.
        SelectionError: The dataset has no such array or label, or no sample is chosen.
        DamagedError: Received bytes have other digests than the manifest lists.
        UnsignedError: Nobody signed the version. Nothing was written.
        ChangedError: The signature is not that of the version. Nothing was written.
        UnknownSignerError: No allowed signer signed the version. Nothing was written.
        ClientError: The coordinator refused, or does not answer; or the disk is too small.
    """
    root = f"/v1/datasets/{dataset}/versions/{version}/files/"
    sealed = _fetch_sealed(client, dataset, version)
    contents = sealed.contents
    signature = _fetch_signature(client, root)
    if allowed_signers is not None:
        check_signature(sealed.files[SEAL_NAME], signature, allowed_signers)

    # All that can be refused is refused before the first byte is written.
    with _selecting():
        selection.choose_arrays(layout(contents.manifest.spec))
    files = part_files(contents, selection, None)
    _check_paths(files)
    refuse_foreign_files(target, contents, f"{dataset}:v{version}")
    refuse_other_part(target, selection)
    target.mkdir(parents=True, exist_ok=True)

    downloader = Downloader(client, root, target, on_bytes, threading.Event())
    part = _Part(files, contents.manifest.valid_count, 0, 0)
    if not selection.is_everything:
        quiet = Downloader(client, root, target, lambda _: None, threading.Event())
        part = _choose_part(quiet, contents, selection, files)
        manifest_digest = sha256(sealed.files[MANIFEST_NAME])
        document = PartDocument(manifest=manifest_digest, selection=selection)
        write_durably(target / SELECTION_NAME, document.model_dump_json(indent=2).encode())

    # Intact files of an earlier pull stay.
    missing = _missing(target, part.files)
    changed = {
        name: content for name, content in sealed.files.items() if _read(target / name) != content
    }
    count = len(missing) + len(changed)
    size = _total_size(missing) + sum(len(content) for content in changed.values())
    _refuse_small_disk(target, size)
    on_plan(count, size)
    downloader.download_all(missing)
    _write_seal(target, signature, changed, on_bytes)
    # The directory holds the whole version now, and no part of it.
    if selection.is_everything:
        (target / SELECTION_NAME).unlink(missing_ok=True)
    return Pulled(
        samples=part.samples,
        files=len(part.files) + len(sealed.files),
        downloaded_files=count + part.label_files,
        downloaded_bytes=size + part.label_bytes,
    )


def _write_seal(
    target: Path,
    signature: bytes | None,
    changed: Mapping[str, bytes],
    on_bytes: Callable[[int], None],
) -> None:
    """Write the signature, and the files that say that the directory is complete.

    They come after all others, the manifest last.
    """
    if signature is not None and _read(target / SIGNATURE_NAME) != signature:
        write_durably(target / SIGNATURE_NAME, signature)
    for name, content in changed.items():
        write_durably(target / name, content)
        on_bytes(len(content))


def _choose_part(
    downloader: Downloader,
    contents: Contents,
    selection: Selection,
    label_files: list[FileEntry],
) -> _Part:
    """Download the labels of a version, and return the files of the samples that they choose."""
    target = downloader.target
    missing = _missing(target, label_files)
    _refuse_small_disk(target, _total_size(missing))
    downloader.download_all(missing)
    # The labels on the disk have been checked, and tell which samples are chosen.
    labels = partial(read_label, target, contents.manifest)
    with _selecting():
        chosen = selection.choose_samples(layout(contents.manifest.spec), labels)
        files = part_files(contents, selection, labels)
    _check_paths(files)
    return _Part(
        files=files,
        samples=int(chosen.sum()),
        label_files=len(missing),
        label_bytes=_total_size(missing),
    )


def _check_paths(files: list[FileEntry]) -> None:
    """Check that each file may be written, and that none is listed twice.

    Raises:
        UnsafePathError: A file would be written outside of the dataset, or be hidden.
        DamagedError: Two entries have one path.
    """
    for file in files:
        check_path(file.path)
    if len({file.path for file in files}) != len(files):
        raise DamagedError(f"{MANIFEST_NAME} lists a file twice")


def _missing(target: Path, files: list[FileEntry]) -> list[FileEntry]:
    """Return the files that a directory does not hold, or holds damaged."""
    return [file for file in files if fault_of(target, file) is not None]


def _total_size(files: list[FileEntry]) -> int:
    return sum(file.size for file in files)


def _refuse_small_disk(target: Path, size: int) -> None:
    """Raise ClientError if the disk has not so many free bytes."""
    free = shutil.disk_usage(target).free
    if size > free:
        raise ClientError(
            f"{target} has {free} bytes free, and the files have {size}: choose another directory, "
            "or a part of the dataset"
        )


@contextmanager
def _selecting() -> Iterator[None]:
    """Turn the ValueError of a wrong selection into a SelectionError."""
    try:
        yield
    except BrokenSectionError as error:
        raise DamagedError(str(error)) from error
    except ValueError as error:
        raise SelectionError(str(error)) from error


def refuse_other_part(target: Path, selection: Selection) -> None:
    """Raise ForeignFilesError if `target` holds another part of a version.

    A whole version replaces any part.
    """
    with suppress(FileNotFoundError):
        present = read_part(target).selection
        if not selection.is_everything and present != selection:
            raise ForeignFilesError(
                f"{target} holds another part of the dataset, {present.model_dump_json()}: pull "
                "all of it, or pull into a new directory"
            )


def refuse_foreign_files(target: Path, contents: Contents, name: str) -> None:
    """Raise ForeignFilesError if `target` holds files that are not of the version `name`.

    A directory that already holds this version may have other files beside it.
    """
    foreign = []
    # In the order of arrays and shards, so that each section is read once.
    for path in sorted(files_below(target)):
        listed_path = path.removesuffix(PART_SUFFIX)
        if listed_path not in RESERVED_NAMES and contents.file(listed_path) is None:
            foreign.append(path)
    # A directory that holds this version may have files of the user beside it.
    present = ""
    with suppress(OSError, ValidationError):
        manifest = Manifest.model_validate_json((target / MANIFEST_NAME).read_bytes())
        present = f"{manifest.dataset}:v{manifest.version}"
    if not foreign or present == name:
        return
    number = "1 file is" if len(foreign) == 1 else f"{len(foreign)} files are"
    holds = f" It holds {present}." if present else ""
    raise ForeignFilesError(
        f"{target} is not empty, and {number} not part of {name}: {min(foreign)}, for example."
        f"{holds} Nothing was written; pull into a new directory"
    )


def _fetch_sealed(client: Client, dataset: str, version: int) -> _Sealed:
    """Return a version; its manifest, metadata, seal and the coordinator's record must agree."""
    base = f"/v1/datasets/{dataset}/versions/{version}"
    record = client.version(dataset, version)
    answer = client.request("GET", f"{base}/manifest")
    content = answer.content
    group = client.request("GET", f"{base}/files/{GROUP_NAME}").content
    seal = client.request("GET", f"{base}/files/{SEAL_NAME}").content
    # The record of the coordinator, the seal and the manifest must tell the same story.
    if (sha256(content), sha256(group)) != (record.manifest, record.group):
        raise DamagedError(
            f"{MANIFEST_NAME} or {GROUP_NAME} of {dataset}, version {version}, does not have the "
            "committed digest"
        )
    try:
        check_seal(content, group, seal)
    except BrokenSealError as error:
        raise DamagedError(f"{dataset}, version {version}: {error}") from error
    manifest = parse(Manifest, content, str(answer.url))
    if (manifest.dataset, manifest.version) != (dataset, version):
        raise DamagedError(
            f"the manifest of {dataset}:v{version} is that of "
            f"{manifest.dataset}:v{manifest.version}"
        )
    check_counts(manifest)
    contents = Contents(manifest, client.section_reader(f"{base}/files/"))
    return _Sealed(contents, {GROUP_NAME: group, SEAL_NAME: seal, MANIFEST_NAME: content})


def _fetch_signature(client: Client, root: str) -> bytes | None:
    """Return the signature of a version; None if nobody signed it."""
    try:
        return client.request("GET", root + SIGNATURE_NAME, limit=SIGNATURE_BYTES).content
    except ProblemError as error:
        # Most versions are not signed.
        if error.problem.status != 404:
            raise
        return None


def _read(path: Path) -> bytes | None:
    """Return the bytes of a file; None if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError:
        return None
