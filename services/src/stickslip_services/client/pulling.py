"""Downloads of dataset versions to a directory.

The manifest lists the files and their digests. Only listed files are written, and a file gets its
name after its digest has been checked. An interrupted download continues: a `.part` file holds the
first bytes of a file, and the rest is requested by range.
"""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import httpx
from pydantic import ValidationError
from stickslip_schemas.base import Sha256, sha256
from stickslip_schemas.format.manifest import (
    GROUP_NAME,
    MANIFEST_NAME,
    SEAL_NAME,
    SIGNATURE_NAME,
    BrokenSealError,
    Contents,
    FileEntry,
    Manifest,
    check_seal,
    layout,
)
from stickslip_schemas.format.selection import SELECTION_NAME, PartDocument, Selection, part_files
from stickslip_schemas.store import sync, write_durably

from stickslip_services.client.http import (
    Client,
    DamagedError,
    ForeignFilesError,
    ProblemError,
    SelectionError,
    UnreachableError,
    parsed,
    raise_for_problem,
)
from stickslip_services.client.verifying import (
    CONNECTIONS,
    EVERYTHING,
    OWN_NAMES,
    PART,
    check_signature,
    fault_of,
    file_digest,
    files_below,
    read_label,
    read_part,
    safe_path,
)

TRIES = 5


@dataclass(frozen=True, slots=True)
class Pulled:
    """Counts of a finished pull; `files` includes the files that were already there."""

    files: int
    downloaded_files: int
    downloaded_bytes: int


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

    Intact files are not downloaded again.

    A part has all labels and, of the other arrays, the shards that hold a chosen sample;
    `selection.json` describes it. The manifest is written last, so a directory with a manifest is
    complete.

    Args: client: A client of the coordinator that has the dataset. dataset: Id of the dataset.
        version: Number of the version. target: Directory to write to. selection: Part to download.
        allowed_signers: File of the signers to trust [ssh-keygen(1)]; without, signatures are not
        checked. on_bytes: Called with the number of bytes of each received block. on_plan: Called
        once, with the number of files and bytes to download.

    Raises: ForeignFilesError: `target` holds other files. Nothing was written. SelectionError: The
        dataset has no such array or label. DamagedError: Received bytes differ from what the
        manifest lists. UnsignedError, ChangedError, UnknownSignerError: No allowed signer signed
        the version. Nothing was written. ClientError: The coordinator refused, or does not answer.
    """
    contents, sealed = _fetch_sealed(client, dataset, version)
    manifest = contents.manifest
    root = f"/v1/datasets/{dataset}/versions/{version}/files/"
    signature = _fetch_signature(client, root)
    if allowed_signers is not None:
        check_signature(sealed[SEAL_NAME], signature, allowed_signers)
    with _selecting():
        selection.choose_arrays(layout(manifest.spec))
    files = _with_paths(target, part_files(contents, selection, None))
    refuse_foreign_files(target, contents, f"{dataset}:v{version}")
    refuse_other_part(target, selection)
    target.mkdir(parents=True, exist_ok=True)
    labels_done = (0, 0)
    if not selection.is_everything:
        labels = [(file, path) for file, path in files if fault_of(target, file)]
        _download_all(client, root, labels, lambda _: None)
        labels_done = (len(labels), sum(file.size for file, _ in labels))
        with _selecting():
            wanted = part_files(
                contents, selection, lambda name: read_label(target, manifest, name)
            )
        files = _with_paths(target, wanted)
        document = PartDocument(manifest=sha256(sealed[MANIFEST_NAME]), selection=selection)
        write_durably(target / SELECTION_NAME, document.model_dump_json(indent=2).encode())
    missing = [(file, path) for file, path in files if fault_of(target, file)]
    changed = {name: content for name, content in sealed.items() if _read(target / name) != content}
    count = len(missing) + len(changed)
    size = sum(file.size for file, _ in missing) + sum(map(len, changed.values()))
    on_plan(count, size)
    _download_all(client, root, missing, on_bytes)
    if signature is not None and _read(target / SIGNATURE_NAME) != signature:
        write_durably(target / SIGNATURE_NAME, signature)
    for name, content in changed.items():
        write_durably(target / name, content)
        on_bytes(len(content))
    if selection.is_everything:
        (target / SELECTION_NAME).unlink(missing_ok=True)
    return Pulled(len(files) + len(sealed), count + labels_done[0], size + labels_done[1])


def _with_paths(target: Path, files: list[FileEntry]) -> list[tuple[FileEntry, Path]]:
    return [(file, safe_path(target, file.path)) for file in files]


def _download_all(
    client: Client,
    root: str,
    missing: list[tuple[FileEntry, Path]],
    on_bytes: Callable[[int], None],
) -> None:
    stop = threading.Event()
    with ThreadPoolExecutor(CONNECTIONS) as pool:
        downloads = [
            pool.submit(_download, client, root, file, path, on_bytes, stop)
            for file, path in missing
        ]
        try:
            for download in as_completed(downloads):
                download.result()
        except BaseException:
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise


@contextmanager
def _selecting() -> Iterator[None]:
    """Turn the ValueError of a wrong selection into a SelectionError."""
    try:
        yield
    except ValueError as error:
        raise SelectionError(str(error)) from error


def refuse_other_part(target: Path, selection: Selection) -> None:
    """Raise ForeignFilesError if `target` holds another part of a version.

    A whole version replaces any part.
    """
    with suppress(FileNotFoundError):
        there = read_part(target).selection
        if not selection.is_everything and there != selection:
            raise ForeignFilesError(
                f"{target} holds another part of the dataset, {there.model_dump_json()}: pull all of it, or pull into "
                "a new directory"
            )


def refuse_foreign_files(target: Path, contents: Contents, name: str) -> None:
    """Raise ForeignFilesError if `target` holds files that `contents`, of the version `name`, does
    not list.

    A directory that already holds this version may have other files beside it.
    """
    found = sorted(files_below(target))  # by array and shard, so that each section is read once
    foreign = [
        path
        for path in found
        if (name_ := path.removesuffix(PART)) not in OWN_NAMES and contents.file(name_) is None
    ]
    there = ""
    with suppress(OSError, ValidationError):
        manifest = Manifest.model_validate_json((target / MANIFEST_NAME).read_bytes())
        there = f"{manifest.dataset}:v{manifest.version}"
    if not foreign or there == name:
        return
    number = "1 file is" if len(foreign) == 1 else f"{len(foreign)} files are"
    holds = f" It holds {there}." if there else ""
    raise ForeignFilesError(
        f"{target} is not empty, and {number} not part of {name}: {min(foreign)}, for example.{holds} Nothing was "
        "written; pull into a new directory"
    )


def _fetch_sealed(client: Client, dataset: str, version: int) -> tuple[Contents, dict[str, bytes]]:
    """Return the contents of a version, and the bytes of its three sealed files by name, the
    manifest last.
    """
    promised = client.version(dataset, version)
    answer = client.request("GET", f"/v1/datasets/{dataset}/versions/{version}/manifest")
    content, root = answer.content, f"/v1/datasets/{dataset}/versions/{version}/files/"
    group, seal = (client.request("GET", root + name).content for name in (GROUP_NAME, SEAL_NAME))
    if (sha256(content), sha256(group)) != (promised.manifest, promised.group):
        raise DamagedError(
            f"{MANIFEST_NAME} or {GROUP_NAME} of {dataset}, version {version}, does not have the committed digest"
        )
    try:
        check_seal(content, group, seal)
    except BrokenSealError as error:
        raise DamagedError(f"{dataset}, version {version}: {error}") from error
    manifest = parsed(Manifest, answer)
    if (manifest.dataset, manifest.version) != (dataset, version):
        raise DamagedError(
            f"the manifest of {dataset}:v{version} is that of {manifest.dataset}:v{manifest.version}"
        )
    contents = Contents(manifest, lambda file: client.request("GET", root + file.path).content)
    return contents, {GROUP_NAME: group, SEAL_NAME: seal, MANIFEST_NAME: content}


def _fetch_signature(client: Client, root: str) -> bytes | None:
    try:
        return client.request("GET", root + SIGNATURE_NAME).content
    except ProblemError as error:
        if error.problem.status != 404:
            raise
        return None


def _read(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except OSError:
        return None


def _download(
    client: Client,
    root: str,
    file: FileEntry,
    path: Path,
    on_bytes: Callable[[int], None],
    stop: threading.Event,
) -> None:
    """Download a file to its `.part` file, check it, and rename it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + PART)
    if part.is_symlink():
        part.unlink()
    on_bytes(part.stat().st_size if part.exists() else 0)
    reason = ""
    for attempt in range(TRIES):
        if stop.wait(0 if attempt == 0 else min(2.0**attempt / 4, client.patience)):
            return
        try:
            _fetch(client, root + file.path, file.sha256, part, on_bytes, stop)
        except httpx.TransportError as error:
            reason = str(error) or type(error).__name__
            continue  # the part keeps the received bytes
        if stop.is_set():
            return
        if part.stat().st_size == file.size and file_digest(part) == file.sha256:
            sync(part)
            part.replace(path)
            return
        part.unlink()  # a part of another file, or damaged in transit: start again
        reason = "it arrived damaged"
    if reason == "it arrived damaged":
        raise DamagedError(
            f"{file.path} arrived {TRIES} times with other bytes than the manifest promises"
        )
    raise UnreachableError(f"{file.path} could not be downloaded in {TRIES} tries: {reason}")


def _fetch(
    client: Client,
    url: str,
    digest: Sha256,
    part: Path,
    on_bytes: Callable[[int], None],
    stop: threading.Event,
) -> None:
    have = part.stat().st_size if part.exists() else 0
    etag = f'"{digest}"'
    headers = {"Accept-Encoding": "identity"} | (
        {"Range": f"bytes={have}-", "If-Range": etag} if have else {}
    )
    with client.stream(url, headers) as response:
        if response.status_code == 416:  # the part is at least as long as the file
            return
        if response.status_code == 503:
            raise httpx.ReadError("the coordinator is busy")
        if response.status_code not in (200, 206):
            response.read()
            raise_for_problem(response)
        mode = "ab" if response.status_code == 206 else "wb"
        with part.open(mode) as target:
            for block in response.iter_raw():
                target.write(block)
                on_bytes(len(block))
                if stop.is_set():
                    return
