"""Verification of a dataset directory (its seal, its files, and the absence of other files), and
signatures.

A signature is that of `ssh-keygen -Y sign` over `manifest.sha256`, with the namespace `stickslip`.
OpenSSH does all cryptography and reads the keys; see ssh-keygen(1). The seal has the digests of the
manifest and of the root's metadata, which have those of all other files, so the signature covers
all of a version.
"""

import hashlib
import os
import subprocess
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from tempfile import NamedTemporaryFile
from typing import TYPE_CHECKING, Any, Literal

from pydantic import ValidationError
from stickslip_schemas.base import Sha256, sha256
from stickslip_schemas.format.manifest import (
    GROUP_NAME,
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
    PartDocument,
    Selection,
    part_files,
    sections_of,
)
from stickslip_schemas.store import write_durably

from stickslip_services.client.http import (
    ChangedError,
    ClientError,
    DamagedError,
    UnknownSignerError,
    UnsafePathError,
    UnsignedError,
)

if TYPE_CHECKING:
    import numpy.typing as npt

CONNECTIONS = 4
"""Files that are read or downloaded at once."""
PART = ".part"
"""Suffix of a file that is being downloaded."""
READS_ARRAYS = find_spec("numcodecs") is not None
"""Whether the extra `arrays` is there: without it, `verify` does not look into the array
`sample_key`.
"""
EVERYTHING = Selection()
OWN_NAMES = (*SEALED_NAMES, SIGNATURE_NAME, SELECTION_NAME)
"""Files of a directory that no manifest lists."""


@dataclass(frozen=True, slots=True)
class Fault:
    path: str
    fault: Literal[
        "missing", "size", "sha256", "extra", "manifest", "seal", "sample_key", "selection"
    ]
    detail: str


def read_part(target: Path) -> PartDocument:
    """Return the part of a version that a directory holds.

    Raise FileNotFoundError if it holds all of it.
    """
    try:
        return PartDocument.model_validate_json((target / SELECTION_NAME).read_bytes())
    except ValidationError as error:
        raise DamagedError(
            f"{target / SELECTION_NAME} is damaged: {str(error).splitlines()[0]}"
        ) from error


def read_label(target: Path, manifest: Manifest, name: str) -> "npt.NDArray[Any]":
    """Return a label of all slots, (slots,) or (slots, n), from the verified files of a directory."""
    import numpy as np  # the extra `arrays`
    from stickslip_schemas.format.codecs import decode_chunk

    array = next(array for array in layout(manifest.spec) if array.name == name)
    numbers = range(-(-manifest.sample_count // manifest.spec.samples_per_file(array)))
    content = b"".join(
        bytes(decode_chunk((target / array.shard_path(number)).read_bytes())) for number in numbers
    )
    return np.frombuffer(content, dtype=array.dtype).reshape(-1, *array.shape)[
        : manifest.sample_count
    ]


def safe_path(target: Path, path: str) -> Path:
    """Return the path of a file of a manifest; raise UnsafePathError if it is not inside `target`.

    Existing symbolic links are followed for the check, so a link that leads out of `target` is
    refused, too.
    """
    parts = PurePosixPath(path).parts
    if (
        not parts
        or path.startswith("/")
        or any(part in ("..", ".") for part in path.split("/"))
        or "\\" in path
    ):
        raise UnsafePathError(
            f"the manifest names the file {path!r}, which leaves the dataset; nothing was written"
        )
    whole = target.joinpath(*parts)
    if not whole.resolve().is_relative_to(target.resolve()):
        raise UnsafePathError(
            f"the file {path!r} would be written outside {target}; nothing was written"
        )
    if path in OWN_NAMES or path.endswith(PART):
        raise UnsafePathError(f"the manifest names the file {path!r}, which is a reserved name")
    return whole


def verify(target: Path) -> list[Fault]:
    """Return the faults of the dataset in `target`, by path; an intact dataset has none."""
    return sorted(_found(target), key=lambda fault: fault.path)


def _found(target: Path) -> list[Fault]:
    """Return the faults of the first check that finds some: of the seal, of a part, of the
    sections, of the files.
    """
    sealed: dict[str, bytes] = {}
    for name in SEALED_NAMES:
        try:
            sealed[name] = (target / name).read_bytes()
        except FileNotFoundError:
            return [
                Fault(name, "missing", "not there: no dataset, or a pull that was not finished")
            ]
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
            return [
                Fault(
                    SELECTION_NAME,
                    "selection",
                    f"of another version, whose manifest is {selection.manifest}",
                )
            ]
        needed = part_files(contents, selection.selection, None)
        if faults := _faults(target, needed):  # the other files of a part follow from its labels
            return faults
        label = partial(read_label, target, manifest)
        numbers = sections_of(contents, selection.selection, label)
        chosen = selection.selection
    except FileNotFoundError:
        label, chosen, numbers = None, EVERYTHING, list(range(max(1, len(manifest.sections))))
    except (DamagedError, ValueError) as error:
        return [Fault(SELECTION_NAME, "selection", str(error))]
    # A damaged section lists no files.
    sections = [manifest.sections[number] for number in numbers] if manifest.sections else []
    if faults := _faults(target, sections):
        return faults
    there = set(files_below(target))
    try:
        wanted = {file.path: file for file in part_files(contents, chosen, label)}
        for path in there:  # files outside the part, of an earlier pull
            if path not in wanted and (file := contents.file(path)) is not None:
                wanted[path] = file
    except (OSError, BrokenSectionError) as error:
        return [Fault(MANIFEST_NAME, "manifest", str(error))]
    faults = _faults(target, list(wanted.values()))
    faults += [
        Fault(path, "extra", "not in the manifest") for path in there - wanted.keys() - {*OWN_NAMES}
    ]
    return faults or (_sample_key_faults(target, contents, numbers) if READS_ARRAYS else [])


def _faults(target: Path, files: list[FileEntry]) -> list[Fault]:
    with ThreadPoolExecutor(CONNECTIONS) as pool:
        return [
            fault
            for fault in pool.map(lambda file: fault_of(target, file), files)
            if fault is not None
        ]


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
        if stored[section.first : section.end].tobytes() != bytes.fromhex(
            "".join(section.sample_keys)
        ):
            path = array.shard_path(section.first // manifest.spec.samples_per_file(array))
            slots = f"slots {section.first} to {section.end - 1}"
            faults.append(
                Fault(path, "sample_key", f"{slots} have other keys than the manifest says")
            )
    return faults


def fault_of(target: Path, file: FileEntry) -> Fault | None:
    """Return what is wrong with a file that a manifest lists; None if it is whole."""
    try:
        path = safe_path(target, file.path)
        size = path.stat().st_size
        if size != file.size:
            return Fault(file.path, "size", f"{size} bytes, and should have {file.size}")
        digest = file_digest(path)
    except UnsafePathError as error:
        return Fault(file.path, "manifest", str(error))
    except FileNotFoundError:
        return Fault(file.path, "missing", "not there")
    except OSError as error:
        return Fault(file.path, "missing", f"cannot be read: {error.strerror}")
    return (
        None
        if digest == file.sha256
        else Fault(file.path, "sha256", f"{digest}, and should be {file.sha256}")
    )


def files_below(target: Path) -> Iterator[str]:
    """Yield the paths of all files below a directory, relative to it."""
    for directory, _, names in os.walk(target):
        for name in names:
            yield (Path(directory) / name).relative_to(target).as_posix()


def file_digest(path: Path) -> Sha256:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


NAMESPACE = "stickslip"


def sign(seal: bytes, key: Path) -> bytes:
    """Return the signature of a seal.

    Raise ClientError if the key, private or of an agent, cannot sign.
    """
    ended = _keygen("sign", "-n", NAMESPACE, "-f", str(key), data=seal)
    if ended.returncode != 0:
        raise ClientError(f"{key} cannot sign: {_last_line(ended)}")
    return ended.stdout


def is_signature(signature: bytes, seal: bytes) -> bool:
    with NamedTemporaryFile() as file:
        file.write(signature)
        file.flush()
        return (
            _keygen("check-novalidate", "-n", NAMESPACE, "-s", file.name, data=seal).returncode == 0
        )


def sign_directory(target: Path, key: Path) -> None:
    """Write the signature of the dataset in a directory; raise DamagedError if the seal is broken."""
    manifest, group, seal = (
        (target / name).read_bytes() for name in (MANIFEST_NAME, GROUP_NAME, SEAL_NAME)
    )
    try:
        check_seal(manifest, group, seal)
    except BrokenSealError as error:
        raise DamagedError(f"{target} is not signed, because it is damaged: {error}") from error
    write_durably(target / SIGNATURE_NAME, sign(seal, key))


def signer_of(target: Path, allowed_signers: Path) -> str:
    """Return who signed the dataset in a directory; raise what `check_signature` raises.

    Files are not checked.
    """
    try:
        signature = (target / SIGNATURE_NAME).read_bytes()
    except FileNotFoundError:
        signature = None
    return check_signature((target / SEAL_NAME).read_bytes(), signature, allowed_signers)


def check_signature(seal: bytes, signature: bytes | None, allowed_signers: Path) -> str:
    """Return who of a file of allowed signers [ssh-keygen(1)] signed a seal.

    Raises:
        UnsignedError: There is no signature.
        ChangedError: The signature is of another seal, or damaged.
        UnknownSignerError: The signature is good, and its key is not that of an allowed signer.
    """
    allowed_signers.open("rb").close()
    if signature is None:
        raise UnsignedError(f"the dataset is not signed: it has no {SIGNATURE_NAME}")
    with NamedTemporaryFile() as file:
        file.write(signature)
        file.flush()
        good = _keygen("check-novalidate", "-n", NAMESPACE, "-s", file.name, data=seal)
        if good.returncode != 0:
            raise ChangedError(
                f"the dataset or its signature was changed: {SIGNATURE_NAME} is no signature of {SEAL_NAME} "
                f"({_last_line(good)})"
            )
        trusted = "-f", str(allowed_signers), "-s", file.name
        names = _keygen("find-principals", *trusted).stdout.decode().splitlines()
        for name in names:
            if _keygen("verify", "-n", NAMESPACE, "-I", name, *trusted, data=seal).returncode == 0:
                return name
    key = good.stdout.decode().strip().rpartition(" with ")[2]
    raise UnknownSignerError(
        f"the dataset was signed by somebody whom {allowed_signers} does not allow, with {key}"
    )


def _keygen(verb: str, *options: str, data: bytes = b"") -> "subprocess.CompletedProcess[bytes]":
    try:
        return subprocess.run(
            ["ssh-keygen", "-Y", verb, *options], input=data, capture_output=True, check=False
        )
    except FileNotFoundError as error:
        raise ClientError(
            "signatures need the program ssh-keygen, of OpenSSH 8.9 or newer"
        ) from error


def _last_line(ended: "subprocess.CompletedProcess[bytes]") -> str:
    return (ended.stderr.decode(errors="replace").strip().splitlines() or ["ssh-keygen failed"])[-1]
