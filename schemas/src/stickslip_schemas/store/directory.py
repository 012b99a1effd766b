"""A store in a directory, which several machines may share.

A file is written beside its place, made durable, then renamed. A version is a directory of hard links, so that it takes
no room and any Zarr reader opens it.
"""

import hashlib
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from stickslip_schemas.base.keys import is_sha256, sha256
from stickslip_schemas.store.base import (
    ARTIFACTS,
    DATASETS,
    VERSION,
    CorruptArtifactError,
    Room,
    ShownVersion,
    Stored,
    artifact_name,
    shown_name,
    version_name,
)

BLOCK = 1 << 18
"""How much of an artifact is held in memory while it is sent [bytes]."""

_PROBE_BYTES = 4096


class DirectoryStore:
    """Artifacts below `root/artifacts` and versions below `root/datasets`; see `Store`."""

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
        """An artifact that is there already is read and compared; a damaged one is mended in all versions."""
        digest = sha256(data)
        if not self.holds(digest, size=len(data)):
            path = self.path(digest)
            links = self.root.glob(f"{DATASETS}/**/*") if path.exists() and path.stat().st_nlink > 1 else ()
            shown = [file for file in links if file.is_file() and file.samefile(path)]
            write_durably(path, data)
            for file in shown:
                _link(path, file)
        return digest

    def read(self, digest: str, *, offset: int = 0, length: int | None = None) -> bytes:
        with self.path(digest).open("rb") as file:
            file.seek(offset)
            data = file.read(-1 if length is None else length)
        if length not in (None, len(data)):
            raise CorruptArtifactError(f"artifact {digest} ends before {offset} + {length}")
        if offset == 0 and length is None and sha256(data) != digest:
            raise CorruptArtifactError(f"artifact {digest} has other bytes than its name says")
        return data

    def stream(self, digest: str, start: int, stop: int) -> Iterator[bytes]:
        with self.path(digest).open("rb") as file:
            file.seek(start)
            while start < stop:
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
            except (ValueError, FileNotFoundError):  # of somebody else, or a writer has finished with it
                continue
            if is_ours:
                is_shown = is_sha256(path.name) and status.st_nlink > 1
                yield Stored(path.name, status.st_size, status.st_mtime, is_shown)

    def show(self, digest: str, dataset: str, version: int, path: str) -> None:
        """Where the file system has no hard links, the bytes are written a second time."""
        target = self.root / shown_name(dataset, version, path)
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            _link(self.path(digest), target)
        except OSError:
            write_durably(target, self.read(digest))

    def shows(self, digest: str, dataset: str, version: int, path: str) -> bool:
        place = self.root / shown_name(dataset, version, path)
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
            if VERSION.fullmatch(version):
                yield ShownVersion(dataset, int(version[1:]), place.stat().st_mtime)

    def hide(self, dataset: str, version: int) -> None:
        directory = self.dataset_path(dataset, version)
        if directory.is_dir():
            shutil.rmtree(directory)
            if not any(directory.parent.iterdir()):
                directory.parent.rmdir()

    def is_shown(self, dataset: str, version: int) -> bool:
        return any(path.is_file() for path in self.dataset_path(dataset, version).rglob("*"))

    def room(self) -> Room:
        place = self.root
        while not place.exists():
            place = place.parent
        return Room(*shutil.disk_usage(place))

    def probe(self) -> None:
        path = self.root / f".probe-{os.getpid()}"
        write_durably(path, bytes(_PROBE_BYTES))
        path.unlink()


def write_durably(path: Path, data: bytes, *, mode: int = 0o666) -> None:
    """Write a file that is there whole or not at all, also after a crash: write, fsync, rename, fsync directory.

    `mode` are its permissions, less those that the umask takes away.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = _scratch_path(path)
    try:
        with os.fdopen(os.open(scratch, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        scratch.replace(path)
    except BaseException:
        scratch.unlink(missing_ok=True)
        raise
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
