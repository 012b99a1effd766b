"""Verification of a dataset directory: its seal, its files, and the absence of other files."""

import hashlib
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import ValidationError
from stickslip_schemas.base import Sha256, sha256
from stickslip_schemas.format.manifest import (
    MANIFEST_NAME,
    SEAL_NAME,
    SEALED_NAMES,
    SIGNATURE_NAME,
    BrokenSealError,
    BrokenSectionError,
    Contents,
    FileEntry,
    Manifest,
    check_seal,
    layout,
)
from stickslip_schemas.format.selection import (
    SELECTION_NAME,
    Labels,
    PartDocument,
    Selection,
    part_files,
    sections_of,
)
from stickslip_schemas.transport.limits import DOCUMENT_BYTES

from stickslip_services.client.answers import first_fault
from stickslip_services.client.errors import DamagedError, UnsafePathError

if TYPE_CHECKING:
    import numpy.typing as npt

CONNECTIONS = 4
"""Files that are read or downloaded at once."""
PART_SUFFIX = ".part"
"""Suffix of a file that is being downloaded."""
READS_ARRAYS = find_spec("numcodecs") is not None
"""Whether the extra `arrays` is installed: without it, `verify` does not check `sample_key`."""
EVERYTHING = Selection()
RESERVED_NAMES = frozenset({*SEALED_NAMES, SIGNATURE_NAME, SELECTION_NAME})
"""Files of a directory that no manifest lists."""


FaultKind = Literal[
    "missing", "size", "sha256", "extra", "manifest", "seal", "sample_key", "selection"
]


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that is wrong with a dataset directory."""

    path: str
    """Path of the file, relative to the directory."""
    fault: FaultKind
    detail: str


class _FaultyError(Exception):
    """A check found a fault that makes all further checks pointless."""

    def __init__(self, path: str, fault: FaultKind, detail: str) -> None:
        super().__init__(detail)
        self.fault = Fault(path, fault, detail)


def read_part(target: Path) -> PartDocument:
    """Return the part of a version that a directory holds.

    Raises:
        FileNotFoundError: It holds all of the version.
        DamagedError: The document is damaged.
    """
    try:
        return PartDocument.model_validate_json((target / SELECTION_NAME).read_bytes())
    except ValidationError as error:
        raise DamagedError(f"{target / SELECTION_NAME} is damaged: {first_fault(error)}") from error


def check_counts(manifest: Manifest) -> None:
    """Check that a manifest states the number of samples that its spec makes.

    Memory and loops follow from this number, so it is checked before anything is read.

    Raises:
        DamagedError: The numbers differ.
    """
    # In a manifest of sections, each section is checked against its slots when it is read.
    expected = manifest.spec.sample_count
    listed = manifest.sample_count if manifest.sections else len(manifest.sample_keys)
    if manifest.sample_count != expected or listed != expected:
        raise DamagedError(
            f"{MANIFEST_NAME} states {manifest.sample_count} samples and lists {listed}, and its "
            f"spec makes {expected}"
        )


def read_label(target: Path, manifest: Manifest, name: str) -> "npt.NDArray[Any]":
    """Return a label of all slots, (slots,) or (slots, n), from the verified files of a directory.

    Raises:
        CorruptChunkError: A chunk does not decode to the size that the layout says.
    """
    import numpy as np  # the extra `arrays`
    from stickslip_schemas.format.codecs import CorruptChunkError, decode_chunk, largest_chunk

    array = next(array for array in layout(manifest.spec) if array.name == name)
    samples_per_file = manifest.spec.samples_per_file(array)
    file_count = -(-manifest.sample_count // samples_per_file)
    chunks = []
    for number in range(file_count):
        # A buffer of the stated size: a chunk that decodes to more is refused, not decoded.
        chunk = np.empty((samples_per_file, *array.shape), dtype=array.dtype)
        file = target / array.shard_path(number)
        if file.stat().st_size > largest_chunk(chunk.nbytes):
            raise CorruptChunkError(
                f"{array.shard_path(number)} is larger than {chunk.nbytes} bytes can be"
            )
        decode_chunk(file.read_bytes(), chunk)
        chunks.append(chunk)
    return np.concatenate(chunks)[: manifest.sample_count]


def check_path(path: str) -> None:
    """Check the path of a file of a manifest, without a look at the disk.

    Names that begin with a dot are refused, because other programs obey some of them:
    `.git/hooks/post-checkout` for example.

    Raises:
        UnsafePathError: The file would lie outside the dataset, be hidden or have a reserved name.
    """
    parts = path.split("/")
    if not all(parts) or "\\" in path or ".." in parts or "." in parts:
        raise UnsafePathError(
            f"the manifest names the file {path!r}, which leaves the dataset; nothing was written"
        )
    # Git, shells and editors run or read hidden files of the folder in which they are started.
    if any(part.startswith(".") for part in parts):
        raise UnsafePathError(
            f"the manifest names the file {path!r}, which is hidden; nothing was written"
        )
    if path in RESERVED_NAMES or path.endswith(PART_SUFFIX):
        raise UnsafePathError(f"the manifest names the file {path!r}, which is a reserved name")


def safe_path(target: Path, path: str) -> Path:
    """Return the path of a file of a manifest below a directory.

    Existing symbolic links are followed for the check, so a link that leads out of `target` is
    refused, too.

    Raises:
        UnsafePathError: See `check_path`; or a link leads out of `target`.
    """
    check_path(path)
    file = target / path
    if not file.resolve().is_relative_to(target.resolve()):
        raise UnsafePathError(
            f"the file {path!r} would be written outside {target}; nothing was written"
        )
    return file


def verify(target: Path) -> list[Fault]:
    """Return the faults of the dataset in `target`, by path; an intact dataset has none.

    Checks follow one another, and the first one that finds faults is the last: of the seal, of a
    part, of the sections, of the files, of the sample keys.
    """
    try:
        faults = _find_faults(target)
    except _FaultyError as error:
        faults = [error.fault]
    return sorted(faults, key=lambda fault: fault.path)


def _find_faults(target: Path) -> list[Fault]:
    sealed = _read_sealed(target)
    manifest = _read_manifest(sealed)

    def read_section(file: FileEntry) -> bytes:
        if file.size > DOCUMENT_BYTES:
            raise BrokenSectionError(f"{file.path} is larger than any section can be")
        return safe_path(target, file.path).read_bytes()

    contents = Contents(manifest, read_section)
    labels: Labels | None = None
    selection = EVERYTHING
    numbers = list(range(max(1, len(manifest.sections))))
    try:
        part = read_part(target)
    except FileNotFoundError:
        pass  # the directory holds the whole version
    except DamagedError as error:
        return [Fault(SELECTION_NAME, "selection", str(error))]
    else:
        # The other files of a part follow from its labels, so these are checked first.
        selection = part.selection
        faults = _check_part(target, contents, part, sha256(sealed[MANIFEST_NAME]))
        if faults:
            return faults
        labels = partial(read_label, target, manifest)
        numbers = sections_of(contents, selection, labels)

    # A damaged section lists no files.
    sections = [manifest.sections[number] for number in numbers] if manifest.sections else []
    faults = _faults_of(target, sections)
    if faults:
        return faults
    faults = _check_files(target, contents, selection, labels)
    if faults or not READS_ARRAYS:
        return faults
    return _sample_key_faults(target, contents, numbers)


def _read_sealed(target: Path) -> dict[str, bytes]:
    """Return the bytes of the three files that vouch for all others, by name."""
    sealed: dict[str, bytes] = {}
    for name in SEALED_NAMES:
        try:
            sealed[name] = (target / name).read_bytes()
        except FileNotFoundError as error:
            detail = "not there: no dataset, or a pull that was not finished"
            raise _FaultyError(name, "missing", detail) from error
        except OSError as error:
            raise _FaultyError(name, "missing", f"cannot be read: {error.strerror}") from error
    return sealed


def _read_manifest(sealed: dict[str, bytes]) -> Manifest:
    """Return the manifest, whose seal holds."""
    try:
        check_seal(*(sealed[name] for name in SEALED_NAMES))
        manifest = Manifest.model_validate_json(sealed[MANIFEST_NAME])
        check_counts(manifest)
    except ValidationError as error:
        raise _FaultyError(MANIFEST_NAME, "manifest", first_fault(error)) from error
    except BrokenSealError as error:
        raise _FaultyError(SEAL_NAME, "seal", str(error)) from error
    except DamagedError as error:
        raise _FaultyError(MANIFEST_NAME, "manifest", str(error)) from error
    return manifest


def _check_part(
    target: Path, contents: Contents, part: PartDocument, manifest_digest: Sha256
) -> list[Fault]:
    """Return the faults of the document of a part, and of the labels that tell its files."""
    if part.manifest != manifest_digest:
        detail = f"of another version, whose manifest is {part.manifest}"
        return [Fault(SELECTION_NAME, "selection", detail)]
    try:
        label_files = part_files(contents, part.selection, None)
    except ValueError as error:
        return [Fault(SELECTION_NAME, "selection", str(error))]
    faults = _faults_of(target, label_files)
    if faults:
        return faults
    try:
        sections_of(contents, part.selection, partial(read_label, target, contents.manifest))
    except ValueError as error:
        return [Fault(SELECTION_NAME, "selection", str(error))]
    return []


def _check_files(
    target: Path, contents: Contents, selection: Selection, labels: Labels | None
) -> list[Fault]:
    """Return the faults of the files of a version or a part, and of files that do not belong."""
    paths = set(files_below(target))
    try:
        expected = {file.path: file for file in part_files(contents, selection, labels)}
        # An earlier pull may have left files of the version outside of the part.
        for path in paths - expected.keys():
            file = contents.file(path)
            if file is not None:
                expected[path] = file
    except (OSError, BrokenSectionError) as error:
        return [Fault(MANIFEST_NAME, "manifest", str(error))]
    faults = _faults_of(target, list(expected.values()))
    for path in paths - expected.keys() - RESERVED_NAMES:
        faults.append(Fault(path, "extra", "not in the manifest"))
    return faults


def _faults_of(target: Path, files: list[FileEntry]) -> list[Fault]:
    # Hashing releases the interpreter's lock, so threads use several cores.
    with ThreadPoolExecutor(CONNECTIONS) as pool:
        faults = list(pool.map(partial(fault_of, target), files))
    return [fault for fault in faults if fault is not None]


def _sample_key_faults(target: Path, contents: Contents, numbers: Iterable[int]) -> list[Fault]:
    """Compare the array `sample_key` with the keys that the sections of the manifest list."""
    from stickslip_schemas.format.codecs import CorruptChunkError

    manifest = contents.manifest
    array = next(array for array in layout(manifest.spec) if array.name == "sample_key")
    try:
        stored = read_label(target, manifest, "sample_key")
    except (OSError, CorruptChunkError) as error:
        return [Fault(array.name, "sample_key", str(error))]
    faults = []
    for number in numbers:
        section = contents.section(number)
        # A shard that was swapped with another has an intact digest, but other keys.
        listed = bytes.fromhex("".join(section.sample_keys))
        if stored[section.first : section.end].tobytes() != listed:
            path = array.shard_path(section.first // manifest.spec.samples_per_file(array))
            slots = f"slots {section.first} to {section.end - 1}"
            detail = f"{slots} have other keys than the manifest says"
            faults.append(Fault(path, "sample_key", detail))
    return faults


def fault_of(target: Path, file: FileEntry) -> Fault | None:
    """Return the fault of a file that a manifest lists; None if it is whole."""
    try:
        # Most files of a new download do not exist, and following links takes time.
        check_path(file.path)
        size = (target / file.path).stat().st_size
        path = safe_path(target, file.path)
        if size != file.size:
            return Fault(file.path, "size", f"{size} bytes, and should have {file.size}")
        digest = file_digest(path)
    except UnsafePathError as error:
        return Fault(file.path, "manifest", str(error))
    except FileNotFoundError:
        return Fault(file.path, "missing", "not there")
    except OSError as error:
        return Fault(file.path, "missing", f"cannot be read: {error.strerror}")
    if digest == file.sha256:
        return None
    return Fault(file.path, "sha256", f"{digest}, and should be {file.sha256}")


def files_below(target: Path) -> Iterator[str]:
    """Yield the paths of all files below a directory, relative to it."""
    for directory, _, names in os.walk(target):
        for name in names:
            yield (Path(directory) / name).relative_to(target).as_posix()


def file_digest(path: Path) -> Sha256:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
