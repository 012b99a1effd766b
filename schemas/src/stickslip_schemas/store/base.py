"""What a store is, wherever it keeps its bytes.

An **artifact** is a run of bytes that is named by its SHA-256. It is there whole or not at all, and two writers of the
same bytes cannot disturb each other. A **version** of a dataset shows some artifacts a second time, under the paths
that a Zarr reader asks for: `datasets/ID/vN/PATH`.
"""

import errno
import re
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

from stickslip_schemas.base.keys import is_sha256

T = TypeVar("T")
R = TypeVar("R")

ARTIFACTS = "artifacts"
DATASETS = "datasets"
VERSION = re.compile(r"v[1-9]\d{0,8}")
"""Name of the directory of a version."""
AT_ONCE = 32
"""Requests to a store at once: a bucket answers each after a while, and all of them after little more."""

_SCRATCH = re.compile(r"\.([0-9a-f]{64})\..*\.tmp")
_UNAVAILABLE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.ESTALE, errno.EHOSTUNREACH)


class CorruptArtifactError(OSError):
    """An artifact's bytes do not have the digest that names them."""


def is_unavailable(error: OSError) -> bool:
    """Return whether an error says that a store takes no files: full, read-only, not ours, gone, or out of reach."""
    return error.errno in _UNAVAILABLE


@dataclass(frozen=True, slots=True)
class Stored:
    """A file among the artifacts: an artifact, or what a writer left when it was ended."""

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


class Room(NamedTuple):
    """Capacity of a store [bytes]."""

    total: int
    used: int
    free: int


class Store(Protocol):
    """Artifacts by digest, and the versions that show them.

    A digest that is not 64 lower-case hexadecimal digits raises ValueError, and an artifact that is not there
    FileNotFoundError. Other failures of the store are OSError too; `is_unavailable` tells which of them mean that it
    takes no files at all.
    """

    def __hash__(self) -> int:
        """Let what was read from a store be cached by it."""

    @property
    def place(self) -> str:
        """What people call the store: its directory or its URL."""

    @property
    def cache(self) -> Path | None:
        """A directory that all workers share for what may be lost; None if the store has none."""

    def publish(self, data: bytes) -> str:
        """Make `data` an artifact, durably, and return its digest. A damaged one is written anew."""

    def read(self, digest: str, *, offset: int = 0, length: int | None = None) -> bytes:
        """Return an artifact's bytes; raise CorruptArtifactError where it is too short.

        A whole artifact is also checked against its digest.
        """

    def stream(self, digest: str, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes from `start` to `stop` in blocks; raise CorruptArtifactError where it ends before."""

    def size(self, digest: str) -> int:
        """Return how long an artifact is [bytes], without reading it."""

    def exists(self, digest: str, *, size: int = 0) -> bool:
        """Return whether an artifact is there with at least `size` bytes, without reading it."""

    def holds(self, digest: str, *, size: int | None = None) -> bool:
        """Return whether an artifact is there, of `size` bytes where that is known, with the digest that names it."""

    def delete(self, name: str) -> None:
        """Delete an artifact, by its digest, or a leftover, by its name in `stored`. Deleting twice is no error."""

    def stored(self) -> Iterator[Stored]:
        """Yield the artifacts and the leftovers, ordered by digest."""

    def show(self, digest: str, dataset: str, version: int, path: str) -> None:
        """Let a version show an artifact at `path`. Showing it twice is no error."""

    def shows(self, digest: str, dataset: str, version: int, path: str) -> bool:
        """Return whether a version shows the bytes of `digest` at `path`. They are read where they are a copy."""

    def read_shown(self, dataset: str, version: int, path: str) -> bytes:
        """Return what a version shows at `path`, unchecked."""

    def versions(self, path: str) -> Iterator[ShownVersion]:
        """Yield the versions that show a file at `path`."""

    def hide(self, dataset: str, version: int) -> None:
        """Let a version show nothing any more; the artifacts stay. Hiding it twice is no error."""

    def is_shown(self, dataset: str, version: int) -> bool:
        """Return whether a version shows anything."""

    def room(self) -> Room | None:
        """Return how full the store is; None if it has no limit that it knows."""

    def probe(self) -> None:
        """Write a small file and delete it; raise OSError where that fails."""


def artifact_name(name: str) -> str:
    """Return the path of an artifact, or of a leftover, below the root of a store; raise ValueError for a bad name."""
    leftover = _SCRATCH.fullmatch(name)
    digest = leftover[1] if leftover else name
    if not is_sha256(digest):
        raise ValueError(f"digest must be 64 lower-case hexadecimal digits, and it is {name!r}")
    if "/" in name:
        raise ValueError(f"name must not have a slash; got {name!r}")
    return f"{ARTIFACTS}/{digest[:2]}/{name}"


def version_name(dataset: str, version: int) -> str:
    """Return the path of a version below the root of a store."""
    return f"{DATASETS}/{dataset}/v{version}"


def shown_name(dataset: str, version: int, path: str) -> str:
    """Return the path of a file of a version below the root of a store; raise ValueError where it leads outside."""
    if any(part in ("", ".", "..") for part in path.split("/")):
        raise ValueError(f"path must be relative, without empty parts, '.' and '..'; got {path!r}")
    return f"{version_name(dataset, version)}/{path}"


def in_parallel(function: Callable[[T], R], items: Iterable[T], *, at_once: int = AT_ONCE) -> list[R]:
    """Return what `function` gives for each item, in their order; raise the first error, and begin nothing more."""
    with ThreadPoolExecutor(at_once) as pool:
        try:
            return list(pool.map(function, items))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
