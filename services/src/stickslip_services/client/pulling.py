"""Pulling a dataset version to a directory, and verifying one that is there.

The manifest says which files there are and what their digests are; nothing that it does not name is written, and
nothing is given its name before its digest has been checked. What was interrupted goes on where it stopped: a `.part`
file holds the first bytes of a file, and the server is asked for the rest.
"""

import hashlib
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import httpx
import numpy as np
import numpy.typing as npt
from pydantic import ValidationError
from stickslip_schemas.base.keys import Sha256, sha256
from stickslip_schemas.format.chunks import CorruptChunkError, decode_chunk
from stickslip_schemas.format.layout import layout
from stickslip_schemas.format.manifest import (
    GROUP_NAME,
    MANIFEST_NAME,
    SEAL_NAME,
    SEALED_NAMES,
    BrokenSealError,
    BrokenSectionError,
    Contents,
    FileEntry,
    Manifest,
    check_seal,
)
from stickslip_schemas.format.selection import SELECTION_NAME, PartDocument, Selection, part_files, sections_of
from stickslip_schemas.store import sync, write_durably

from stickslip_services.client.calls import ClientError, UnreachableError, raise_for_problem
from stickslip_services.client.http import Client

CONNECTIONS = 4
TRIES = 5
PART = ".part"
EVERYTHING = Selection()


class UnsafePathError(ClientError):
    """A manifest names a file outside its dataset."""


class ForeignFilesError(ClientError):
    """The directory holds files that are not of the dataset."""


class DamagedError(ClientError):
    """What arrived is not what the manifest promises."""


class SelectionError(ClientError):
    """The dataset has no such array or label."""


@dataclass(frozen=True, slots=True)
class Pulled:
    """What a pull did."""

    files: int
    downloaded_files: int
    downloaded_bytes: int


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong with a file of a dataset on disk."""

    path: str
    fault: Literal["missing", "size", "sha256", "extra", "manifest", "seal", "sample_key", "selection"]
    detail: str


def pull(
    client: Client,
    dataset: str,
    version: int,
    target: Path,
    *,
    selection: Selection = EVERYTHING,
    on_bytes: Callable[[int], None] = lambda _: None,
    on_plan: Callable[[int, int], None] = lambda _files, _bytes: None,
) -> Pulled:
    """Download a version, or the part that `selection` chooses, to `target`; what is there and right is left alone.

    `on_plan` hears how many files and bytes are to come, `on_bytes` of each piece that arrives. The manifest is written
    last: where it is, the dataset is whole. Raise ForeignFilesError, and write nothing, where `target` holds files of
    something else: mixed with them, the dataset would not be what its manifest says. Raise SelectionError where the
    selection makes no sense for this dataset.

    A part has all labels, and of the other arrays the shards in which a chosen sample lies. `selection.json` says so.
    """
    contents, sealed = _fetch_sealed(client, dataset, version)
    manifest = contents.manifest
    with _told():
        selection.choose_arrays(layout(manifest.spec))
    files = _placed(target, part_files(contents, selection, None))
    refuse_foreign_files(target, contents, f"{dataset}:v{version}")
    refuse_other_part(target, selection)
    target.mkdir(parents=True, exist_ok=True)
    root = f"/v1/datasets/{dataset}/versions/{version}/files/"
    labels_done = (0, 0)
    if not selection.is_everything:
        labels = [(file, path) for file, path in files if not _is_whole(path, file)]
        _download_all(client, root, labels, lambda _: None)
        labels_done = (len(labels), sum(file.size for file, _ in labels))
        with _told():
            wanted = part_files(contents, selection, lambda name: _label(target, manifest, name))
        files = _placed(target, wanted)
        document = PartDocument(manifest=sha256(sealed[MANIFEST_NAME]), selection=selection)
        write_durably(target / SELECTION_NAME, document.model_dump_json(indent=2).encode())
    missing = [(file, path) for file, path in files if not _is_whole(path, file)]
    changed = {name: content for name, content in sealed.items() if _content(target / name) != content}
    count = len(missing) + len(changed)
    size = sum(file.size for file, _ in missing) + sum(map(len, changed.values()))
    on_plan(count, size)
    _download_all(client, root, missing, on_bytes)
    for name, content in changed.items():
        write_durably(target / name, content)
        on_bytes(len(content))
    if selection.is_everything:
        (target / SELECTION_NAME).unlink(missing_ok=True)
    return Pulled(len(files) + len(sealed), count + labels_done[0], size + labels_done[1])


def _placed(target: Path, files: list[FileEntry]) -> list[tuple[FileEntry, Path]]:
    return [(file, safe_path(target, file.path)) for file in files]


def _download_all(
    client: Client, root: str, missing: list[tuple[FileEntry, Path]], on_bytes: Callable[[int], None]
) -> None:
    stop = threading.Event()
    with ThreadPoolExecutor(CONNECTIONS) as pool:
        downloads = [pool.submit(_download, client, root, file, path, on_bytes, stop) for file, path in missing]
        try:
            for download in as_completed(downloads):
                download.result()
        except BaseException:
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise


@contextmanager
def _told() -> Iterator[None]:
    """Turn what a selection may be wrong about into a SelectionError."""
    try:
        yield
    except ValueError as error:
        raise SelectionError(str(error)) from error


def refuse_other_part(target: Path, selection: Selection) -> None:
    """Raise ForeignFilesError where `target` holds another part of a version; all of it may always be pulled."""
    with suppress(FileNotFoundError):
        there = read_part(target).selection
        if not selection.is_everything and there != selection:
            raise ForeignFilesError(
                f"{target} holds another part of the dataset, {there.model_dump_json()}: pull all of it, or pull into "
                "a new directory"
            )


def read_part(target: Path) -> PartDocument:
    """Return which part of a version a directory holds; raise FileNotFoundError where it holds all of it."""
    try:
        return PartDocument.model_validate_json((target / SELECTION_NAME).read_bytes())
    except ValidationError as error:
        raise DamagedError(f"{target / SELECTION_NAME} is damaged: {str(error).splitlines()[0]}") from error


def _label(target: Path, manifest: Manifest, name: str) -> npt.NDArray[Any]:
    """Return a label of all slots from the files of a directory, which have been checked."""
    array = next(array for array in layout(manifest.spec) if array.name == name)
    numbers = range(-(-manifest.sample_count // manifest.samples_per_file(array)))
    content = b"".join(bytes(decode_chunk((target / array.shard_path(number)).read_bytes())) for number in numbers)
    return np.frombuffer(content, dtype=array.dtype).reshape(-1, *array.shape)[: manifest.sample_count]


def refuse_foreign_files(target: Path, contents: Contents, name: str) -> None:
    """Raise ForeignFilesError where `target` holds files that are not of the version `name`, which has `contents`.

    A directory that holds this very version may have files of yours beside it: pulling mends it.
    """
    found = sorted(_files_below(target))  # by array and shard, so that each section is read once
    own = {*SEALED_NAMES, SELECTION_NAME}
    foreign = [path for path in found if (name_ := path.removesuffix(PART)) not in own and contents.file(name_) is None]
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
    """Return what the manifest lists, and the bytes of the three files that vouch for a version, the manifest last."""
    promised = client.version(dataset, version)
    if promised.group is None:
        raise DamagedError(
            f"version {version} of {dataset} was made before versions were sealed, and nothing vouches for its "
            "manifest: submit its spec again to make a sealed version"
        )
    manifest, content = client.manifest(dataset, version)
    root = f"/v1/datasets/{dataset}/versions/{version}/files/"
    group, seal = (client.request("GET", root + name).content for name in (GROUP_NAME, SEAL_NAME))
    if (sha256(content), sha256(group)) != (promised.manifest, promised.group):
        raise DamagedError(
            f"{MANIFEST_NAME} or {GROUP_NAME} of {dataset}, version {version}, has not the digest that was promised"
        )
    try:
        check_seal(content, group, seal)
    except BrokenSealError as error:
        raise DamagedError(f"{dataset}, version {version}: {error}") from error
    contents = Contents(manifest, lambda file: client.request("GET", root + file.path).content)
    return contents, {GROUP_NAME: group, SEAL_NAME: seal, MANIFEST_NAME: content}


def _content(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except OSError:
        return None


def safe_path(target: Path, path: str) -> Path:
    """Return where a file of a manifest goes; raise UnsafePathError where that is not inside `target`.

    Symbolic links that are there already are followed for the check, so none of them leads out either.
    """
    parts = PurePosixPath(path).parts
    if not parts or path.startswith("/") or any(part in ("..", ".") for part in path.split("/")) or "\\" in path:
        raise UnsafePathError(f"the manifest names the file {path!r}, which leaves the dataset; nothing was written")
    whole = target.joinpath(*parts)
    if not whole.resolve().is_relative_to(target.resolve()):
        raise UnsafePathError(f"the file {path!r} would be written outside {target}; nothing was written")
    if path in (*SEALED_NAMES, SELECTION_NAME) or path.endswith(PART):
        raise UnsafePathError(f"the manifest names the file {path!r}, a name that is not its to give")
    return whole


def verify(target: Path) -> list[Fault]:
    """Return all that is wrong with the dataset in `target`."""
    sealed: dict[str, bytes] = {}
    for name in SEALED_NAMES:
        try:
            sealed[name] = (target / name).read_bytes()
        except FileNotFoundError:
            return [Fault(name, "missing", "not there: no dataset, or a pull that was not finished")]
        except OSError as error:
            return [Fault(name, "missing", f"cannot be read: {error.strerror}")]
    try:
        check_seal(*(sealed[name] for name in SEALED_NAMES))
        manifest = Manifest.model_validate_json(sealed[MANIFEST_NAME])
    except ValidationError as error:
        return [Fault(MANIFEST_NAME, "manifest", str(error).splitlines()[0])]
    except BrokenSealError as error:
        return [Fault(SEAL_NAME, "seal", str(error))]
    contents = Contents(manifest, lambda file: safe_path(target, file.path).read_bytes())
    try:
        selection = read_part(target)
        if selection.manifest != sha256(sealed[MANIFEST_NAME]):
            return [Fault(SELECTION_NAME, "selection", f"of another version, whose manifest is {selection.manifest}")]
        needed = part_files(contents, selection.selection, None)
        if faults := _faults(target, needed):  # the labels tell what else belongs to the part
            return sorted(faults, key=lambda fault: fault.path)
        label = partial(_label, target, manifest)
        numbers = sections_of(contents, selection.selection, label)
        chosen = selection.selection
    except FileNotFoundError:
        label, chosen, numbers = None, EVERYTHING, list(range(max(1, len(manifest.sections))))
    except (DamagedError, ValueError) as error:
        return [Fault(SELECTION_NAME, "selection", str(error))]
    # A section that is damaged lists nothing.
    sections = [manifest.sections[number] for number in numbers] if manifest.sections else []
    if faults := _faults(target, sections):
        return sorted(faults, key=lambda fault: fault.path)
    there = set(_files_below(target))
    try:
        wanted = {file.path: file for file in part_files(contents, chosen, label)}
        for path in there:  # more than the part: what was pulled before
            if path not in wanted and (file := contents.file(path)) is not None:
                wanted[path] = file
    except (OSError, BrokenSectionError) as error:
        return [Fault(MANIFEST_NAME, "manifest", str(error))]
    faults = _faults(target, list(wanted.values()))
    for path in there:
        if path not in wanted and path not in (*SEALED_NAMES, SELECTION_NAME):
            faults.append(Fault(path, "extra", "not in the manifest"))
    if not faults:
        faults = _sample_key_faults(target, contents, numbers)
    return sorted(faults, key=lambda fault: fault.path)


def _faults(target: Path, files: list[FileEntry]) -> list[Fault]:
    with ThreadPoolExecutor(CONNECTIONS) as pool:
        return [fault for fault in pool.map(lambda file: _fault(target, file), files) if fault is not None]


def _sample_key_faults(target: Path, contents: Contents, numbers: Iterable[int]) -> list[Fault]:
    """Compare the array `sample_key` with the keys that sections of the manifest list by slot."""
    manifest = contents.manifest
    array = next(array for array in layout(manifest.spec) if array.name == "sample_key")
    try:
        stored = _label(target, manifest, "sample_key")
    except (OSError, CorruptChunkError) as error:
        return [Fault(array.name, "sample_key", str(error))]
    faults = []
    for number in numbers:
        section = contents.section(number)
        if stored[section.first : section.end].tobytes() != bytes.fromhex("".join(section.sample_keys)):
            path = array.shard_path(section.first // manifest.samples_per_file(array))
            slots = f"slots {section.first} to {section.end - 1}"
            faults.append(Fault(path, "sample_key", f"{slots} have other keys than the manifest says"))
    return faults


def _fault(target: Path, file: FileEntry) -> Fault | None:
    try:
        path = safe_path(target, file.path)
        size = path.stat().st_size
        if size != file.size:
            return Fault(file.path, "size", f"{size} bytes, and should have {file.size}")
        digest = _digest(path)
    except UnsafePathError as error:
        return Fault(file.path, "manifest", str(error))
    except FileNotFoundError:
        return Fault(file.path, "missing", "not there")
    except OSError as error:
        return Fault(file.path, "missing", f"cannot be read: {error.strerror}")
    return None if digest == file.sha256 else Fault(file.path, "sha256", f"{digest}, and should be {file.sha256}")


def _files_below(target: Path) -> Iterator[str]:
    for directory, _, names in os.walk(target):
        for name in names:
            yield (Path(directory) / name).relative_to(target).as_posix()


def _download(
    client: Client, root: str, file: FileEntry, path: Path, on_bytes: Callable[[int], None], stop: threading.Event
) -> None:
    """Download a file beside its place, check it, and move it there."""
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
            continue  # what has arrived stays in the part
        if stop.is_set():
            return
        if part.stat().st_size == file.size and _digest(part) == file.sha256:
            sync(part)
            part.replace(path)
            return
        part.unlink()  # a part of something else, or damaged on its way: from the beginning
        reason = "it arrived damaged"
    if reason == "it arrived damaged":
        raise DamagedError(f"{file.path} arrived {TRIES} times with other bytes than the manifest promises")
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
    headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={have}-", "If-Range": etag} if have else {})
    with client.stream(url, headers) as response:
        if response.status_code == 416:  # the part is as long as the file already, or longer
            return
        if response.status_code == 503:
            raise httpx.ReadError("the coordinator is busy")
        if response.status_code not in (200, 206):
            response.read()
            raise_for_problem(response)
        mode = "ab" if response.status_code == 206 else "wb"
        with part.open(mode) as target:
            for block in response.iter_raw():  # as it comes: what has arrived is kept if the rest does not
                target.write(block)
                on_bytes(len(block))
                if stop.is_set():
                    return


def _is_whole(path: Path, file: FileEntry) -> bool:
    with suppress(OSError):
        return path.stat().st_size == file.size and _digest(path) == file.sha256
    return False


def _digest(path: Path) -> Sha256:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
