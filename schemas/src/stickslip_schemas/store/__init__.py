"""The store of artifacts and dataset versions: its interface, and a store in a directory.

An **artifact** is a run of bytes that is named by its SHA-256. It is there whole or not at all, and
two writers of the same bytes cannot disturb each other. A **version** of a dataset shows some
artifacts a second time, under the paths that a Zarr reader asks for: `datasets/ID/vN/PATH`.
"""

import errno
import hashlib
import os
import re
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar
from urllib.parse import quote, unquote, urlsplit

from stickslip_schemas.base import is_sha256, sha256
from stickslip_schemas.installation import install_hint

T = TypeVar("T")
R = TypeVar("R")

ARTIFACTS = "artifacts"
DATASETS = "datasets"
VERSION = re.compile(r"v[1-9]\d{0,8}")
"""Name of the directory of a version."""
AT_ONCE = 32
"""Requests to a store at once: a bucket answers each after a while, and all of them after little
more.
"""

# A writer works on `.DIGEST.UNIQUE.tmp` beside the artifact, and renames it when it is whole.
_SCRATCH = re.compile(r"\.([0-9a-f]{64})\..*\.tmp")
# Errors that say something about the whole store. Others are about one file.
_UNAVAILABLE = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.ESTALE,
    errno.EHOSTUNREACH,
)


class CorruptArtifactError(OSError):
    """An artifact's bytes do not have the digest that names them."""


def is_unavailable(error: OSError) -> bool:
    """Return whether an error says that a store takes no files.

    It is full, read-only, of somebody else, gone, or out of reach.
    """
    return error.errno in _UNAVAILABLE


@dataclass(frozen=True, slots=True)
class Stored:
    """A file among the artifacts: an artifact, or a leftover of a writer that was ended."""

    name: str
    """The digest of an artifact. A leftover has another name, which `delete` takes as well."""
    bytes: int
    modified_at: float
    """When it was written last [s since 1970]."""
    is_shown: bool
    """Whether a version is known to show it."""


@dataclass(frozen=True, slots=True)
class ShownVersion:
    """A version that shows a certain file."""

    dataset: str
    version: int
    modified_at: float
    """When that file was written last [s since 1970]."""


class DiskUsage(NamedTuple):
    """Capacity of a store [bytes]."""

    total: int
    used: int
    free: int


class Store(Protocol):
    """Artifacts by digest, and the versions that show them.

    A digest that is not 64 lower-case hexadecimal digits raises ValueError, and an artifact that is
    not there FileNotFoundError. Other failures of the store are OSError too; `is_unavailable` tells
    which of them mean that it takes no files at all.
    """

    def __hash__(self) -> int:
        """Let data of a store be cached by the store."""

    @property
    def place(self) -> str:
        """The name of the store for people: its directory or its URL."""

    @property
    def cache(self) -> Path | None:
        """A directory of all workers for files that may be lost; None if there is none."""

    def publish(self, data: bytes) -> str:
        """Make `data` an artifact, durably, and return its digest; write a damaged one anew."""

    def read(self, digest: str, *, offset: int = 0, length: int | None = None) -> bytes:
        """Return an artifact's bytes; raise CorruptArtifactError if it is too short.

        A whole artifact is also checked against its digest.
        """

    def stream(self, digest: str, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes from `start` to `stop` in blocks.

        Raises CorruptArtifactError if it ends before.
        """

    def size(self, digest: str) -> int:
        """Return how long an artifact is [bytes], without reading it."""

    def exists(self, digest: str, *, size: int = 0) -> bool:
        """Return whether an artifact is there with at least `size` bytes, without reading it."""

    def holds(self, digest: str, *, size: int | None = None) -> bool:
        """Return whether an artifact is there with the digest that names it.

        A known `size` [bytes] is compared first.
        """

    def delete(self, name: str) -> None:
        """Delete an artifact, by its digest, or a leftover, by its name in `stored`.

        Deleting twice is no error.
        """

    def stored(self) -> Iterator[Stored]:
        """Yield the artifacts and the leftovers, ordered by digest."""

    def show(self, digest: str, dataset: str, version: int, path: str) -> None:
        """Let a version show an artifact at `path`. Showing it twice is no error."""

    def shows(self, digest: str, dataset: str, version: int, path: str) -> bool:
        """Return whether a version shows the bytes of `digest` at `path`.

        A copy is read; a link is not.
        """

    def read_shown(self, dataset: str, version: int, path: str) -> bytes:
        """Return the file of a version at `path`, unchecked."""

    def versions(self, path: str) -> Iterator[ShownVersion]:
        """Yield the versions that show a file at `path`."""

    def version_files(self) -> Iterator[tuple[str, int, str]]:
        """Yield the files that versions show: dataset, version and path."""

    def hide(self, dataset: str, version: int) -> None:
        """Let a version show nothing any more; the artifacts stay. Hiding it twice is no error."""

    def is_shown(self, dataset: str, version: int) -> bool:
        """Return whether a version shows anything."""

    def disk_usage(self) -> DiskUsage | None:
        """Return how full the store is; None if it has no limit that it knows."""

    def probe(self) -> None:
        """Write a small file and delete it; raise OSError if that fails."""


def artifact_name(name: str) -> str:
    """Return the path of an artifact, or of a leftover, below the root of a store.

    Raise ValueError for a bad name.
    """
    leftover = _SCRATCH.fullmatch(name)
    digest = leftover[1] if leftover else name
    # Names become paths, so a name that is no digest could lead out of the store.
    if not is_sha256(digest):
        raise ValueError(f"digest must be 64 lower-case hexadecimal digits, and it is {name!r}")
    if "/" in name:
        raise ValueError(f"name must not have a slash; got {name!r}")
    return f"{ARTIFACTS}/{digest[:2]}/{name}"


def version_name(dataset: str, version: int) -> str:
    """Return the path of a version below the root of a store."""
    return f"{DATASETS}/{dataset}/v{version}"


def shown_name(dataset: str, version: int, path: str) -> str:
    """Return the path of a file of a version below the root of a store.

    Raises ValueError if it leads outside.
    """
    # Paths come from manifests, which may be of anybody.
    if any(part in ("", ".", "..") for part in path.split("/")):
        raise ValueError(f"path must be relative, without empty parts, '.' and '..'; got {path!r}")
    return f"{version_name(dataset, version)}/{path}"


def in_parallel(
    function: Callable[[T], R], items: Iterable[T], *, at_once: int = AT_ONCE
) -> list[R]:
    """Return the results of `function` for each item, in their order.

    Raise the first error, and begin nothing more.
    """
    # Threads wait for a disk or a server, so more of them than cores are of use.
    with ThreadPoolExecutor(at_once) as pool:
        try:
            return list(pool.map(function, items))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")
"""How a URL begins, also one with too few slashes: `s3:/bucket` is no directory."""


def store_place(place: str | Path) -> str:
    """Return the place of a store, a path or a URL; raise ValueError.

    Every process of a machine understands it alike.
    """
    text = str(place)
    # Without a scheme it is a directory. Processes have different working directories.
    if _SCHEME.match(text) is None and text:
        return str(Path(text).absolute())
    try:
        url = urlsplit(text)
    except ValueError:
        url = urlsplit("")
    # A URL of another host is no directory of this machine.
    if text.startswith("file://") and url.netloc in ("", "localhost") and url.path.startswith("/"):
        return str(Path(unquote(url.path)))
    if (
        text.startswith("s3://")
        and re.fullmatch(r"[a-z0-9][a-z0-9.-]*", url.netloc)
        and not (url.query or url.fragment)
    ):
        return f"s3://{url.netloc}/{quote(unquote(url.path).strip('/'))}".rstrip("/")
    raise ValueError(
        f"store must be a directory, file:///DIRECTORY or s3://BUCKET/PREFIX; got {text!r}. "
        "Write ./NAME for a directory whose name has a colon."
    )


def open_store(place: str | Path) -> Store:
    """Open the store at a place; see `store_place`. Nothing is written, and no server is asked.

    Raises ValueError if there is no such sort of store, or if its library is not installed.
    """
    place = store_place(place)
    if not place.startswith("s3://"):
        return DirectoryStore(place)
    try:
        from stickslip_schemas.store.bucket import BucketStore
    except ModuleNotFoundError as error:
        raise ValueError(
            f"the store {place} needs obstore, which is not installed: "
            + install_hint("stickslip-schemas", "s3")
        ) from error
    url = urlsplit(place)
    return BucketStore(url.netloc, unquote(url.path).strip("/"))


BLOCK = 1 << 18
"""How much of an artifact is held in memory while it is sent [bytes]."""

_PROBE_BYTES = 4096


class DirectoryStore:
    """Artifacts below `root/artifacts` and versions below `root/datasets`; see `Store`.

    Several machines may share it.

    A file is written beside its place, made durable, then renamed. A version is a directory of hard
    links, so that it takes no room and any Zarr reader opens it.
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)

    @property
    def place(self) -> str:
        return str(self.root)

    @property
    def cache(self) -> Path:
        return self.root

    def path(self, digest: str) -> Path:
        return self.root / artifact_name(digest)

    def dataset_path(self, dataset: str, version: int) -> Path:
        return self.root / version_name(dataset, version)

    def publish(self, data: bytes) -> str:
        """An artifact that is there already is read and compared.

        A damaged one is mended in all versions.
        """
        digest = sha256(data)
        # An artifact that is there and whole is not written again.
        if not self.holds(digest, size=len(data)):
            path = self.path(digest)
            links = (
                self.root.glob(f"{DATASETS}/**/*")
                if path.exists() and path.stat().st_nlink > 1
                else ()
            )
            # Versions show a damaged artifact by hard links, which all need the new file.
            damaged_links = [file for file in links if file.is_file() and file.samefile(path)]
            write_durably(path, data)
            # The link of a version still leads to the damaged file.
            for file in damaged_links:
                _link(path, file)
        return digest

    def read(self, digest: str, *, offset: int = 0, length: int | None = None) -> bytes:
        with self.path(digest).open("rb") as file:
            file.seek(offset)
            data = file.read(-1 if length is None else length)
        if length not in (None, len(data)):
            raise CorruptArtifactError(f"artifact {digest} ends before {offset} + {length}")
        # A part of an artifact cannot be checked: its digest is of the whole.
        if offset == 0 and length is None and sha256(data) != digest:
            raise CorruptArtifactError(f"artifact {digest} has other bytes than its name says")
        return data

    def stream(self, digest: str, start: int, stop: int) -> Iterator[bytes]:
        with self.path(digest).open("rb") as file:
            file.seek(start)
            while start < stop:
                # In blocks, so that a large file needs little memory.
                block = file.read(min(BLOCK, stop - start))
                if not block:
                    raise CorruptArtifactError(f"artifact {digest} ends before {stop}")
                start += len(block)
                yield block

    def size(self, digest: str) -> int:
        return self.path(digest).stat().st_size

    def exists(self, digest: str, *, size: int = 0) -> bool:
        try:
            return self.size(digest) >= size
        except OSError:
            return False

    def holds(self, digest: str, *, size: int | None = None) -> bool:
        try:
            with self.path(digest).open("rb") as file:
                # The size is cheap to compare. The digest reads the file.
                if size is not None and os.fstat(file.fileno()).st_size != size:
                    return False
                return hashlib.file_digest(file, "sha256").hexdigest() == digest
        except OSError:
            return False

    def delete(self, name: str) -> None:
        self.path(name).unlink(missing_ok=True)

    def stored(self) -> Iterator[Stored]:
        """Files with names that no store gives are left out."""
        for path in sorted((self.root / ARTIFACTS).glob("*/*")):
            try:
                is_ours = path == self.path(path.name)
                status = path.stat()
            except (
                ValueError,
                FileNotFoundError,
            ):  # of somebody else, or a writer has finished with it
                continue
            # A file with more than one link is shown by a version.
            if is_ours:
                is_shown = is_sha256(path.name) and status.st_nlink > 1
                yield Stored(path.name, status.st_size, status.st_mtime, is_shown)

    def show(self, digest: str, dataset: str, version: int, path: str) -> None:
        """If the file system has no hard links, the bytes are written a second time."""
        target = self.root / shown_name(dataset, version, path)
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            _link(self.path(digest), target)
        except OSError:
            write_durably(target, self.read(digest))

    def shows(self, digest: str, dataset: str, version: int, path: str) -> bool:
        place = self.root / shown_name(dataset, version, path)
        # A hard link has the bytes of its artifact, and need not be read.
        with suppress(OSError):
            if place.samefile(self.path(digest)):
                return True
        try:
            return sha256(place.read_bytes()) == digest
        except OSError:
            return False

    def read_shown(self, dataset: str, version: int, path: str) -> bytes:
        return (self.root / shown_name(dataset, version, path)).read_bytes()

    def versions(self, path: str) -> Iterator[ShownVersion]:
        for place in sorted(self.root.glob(f"{DATASETS}/*/v*/{path}")):
            dataset, version = place.relative_to(self.root / DATASETS).parts[:2]
            # Other directories are not ours.
            if VERSION.fullmatch(version):
                yield ShownVersion(dataset, int(version[1:]), place.stat().st_mtime)

    def version_files(self) -> Iterator[tuple[str, int, str]]:
        root = self.root / DATASETS
        for place in sorted(root.glob("*/v*/**/*")):
            dataset, version, *parts = place.relative_to(root).parts
            # Other directories are not ours.
            if VERSION.fullmatch(version) and place.is_file():
                yield dataset, int(version[1:]), "/".join(parts)

    def hide(self, dataset: str, version: int) -> None:
        directory = self.dataset_path(dataset, version)
        if directory.is_dir():
            # The links go; the artifacts stay.
            shutil.rmtree(directory)
            if not any(directory.parent.iterdir()):
                directory.parent.rmdir()

    def is_shown(self, dataset: str, version: int) -> bool:
        return any(path.is_file() for path in self.dataset_path(dataset, version).rglob("*"))

    def disk_usage(self) -> DiskUsage:
        place = self.root
        # The directory is created by the first artifact; its file system is known before.
        while not place.exists():
            place = place.parent
        return DiskUsage(*shutil.disk_usage(place))

    def probe(self) -> None:
        path = self.root / f".probe-{os.getpid()}"
        write_durably(path, bytes(_PROBE_BYTES))
        path.unlink()


def write_durably(path: Path, data: bytes, *, mode: int = 0o666) -> None:
    """Write a file durably: write, fsync, rename, fsync of the directory.

    It is there whole or not at all, also after a crash.

    `mode` are its permissions, less the ones of the umask.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Readers see the old file or the new one, and never a part of it.
    scratch = _scratch_path(path)
    try:
        with os.fdopen(os.open(scratch, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
            file.flush()
            # Without this, the name may be on disk before the bytes are.
            os.fsync(file.fileno())
        scratch.replace(path)
    except BaseException:
        scratch.unlink(missing_ok=True)
        raise
    # Now the name itself must be on disk, too.
    sync(path.parent)


def sync(path: Path) -> None:
    """Wait until the disk has a file, or the names in a directory, as they are now."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _link(path: Path, target: Path) -> None:
    """Replace `target` by a hard link to the file at `path`."""
    scratch = _scratch_path(target)
    os.link(path, scratch)
    scratch.replace(target)
    scratch.unlink(missing_ok=True)  # replace() does nothing where both names are one file already


def _scratch_path(path: Path) -> Path:
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
