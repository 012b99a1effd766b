"""The store: content-addressed files on a shared directory.

An artifact is a file named by its SHA-256. It is written beside its place, made durable, then renamed, so that a
reader sees all of it or nothing, and two writers of the same bytes cannot disturb each other.
"""

import errno
import hashlib
import os
import uuid
from pathlib import Path

from stickslip_schemas.keys import is_sha256, sha256


class CorruptArtifactError(OSError):
    """An artifact's bytes do not have the digest that names them."""


_UNAVAILABLE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.ESTALE)


def is_unavailable(error: OSError) -> bool:
    """Tell whether an error says that a store takes no files: it is full, read-only, not ours, or gone."""
    return error.errno in _UNAVAILABLE


class Store:
    """Artifacts below `root/artifacts` and dataset directories below `root/datasets`."""

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)

    def path(self, digest: str) -> Path:
        """Return where the artifact lies or would lie."""
        if not is_sha256(digest):
            raise ValueError(f"digest must be 64 lower-case hexadecimal digits, and it is {digest!r}")
        return self.root / "artifacts" / digest[:2] / digest

    def dataset_path(self, dataset: str, version: int) -> Path:
        """Return the directory of a dataset version."""
        return self.root / "datasets" / dataset / f"v{version}"

    def publish(self, data: bytes) -> str:
        """Make `data` an artifact, durably, and return its digest.

        An artifact that is there already is read and compared, and written anew where its bytes have changed.
        """
        digest = sha256(data)
        if not self.holds(digest, size=len(data)):
            write_durably(self.path(digest), data)
        return digest

    def has(self, digest: str, *, size: int) -> bool:
        """Tell whether an artifact is there with at least `size` bytes, without reading it."""
        try:
            return self.path(digest).stat().st_size >= size
        except OSError:
            return False

    def holds(self, digest: str, *, size: int | None = None) -> bool:
        """Tell whether an artifact is there, of `size` bytes where that is known, with the digest that names it."""
        try:
            with self.path(digest).open("rb") as file:
                if size is not None and os.fstat(file.fileno()).st_size != size:
                    return False
                return hashlib.file_digest(file, "sha256").hexdigest() == digest
        except OSError:
            return False

    def read(self, digest: str, *, offset: int = 0, length: int | None = None) -> bytes:
        """Return an artifact's bytes; a whole artifact is checked against its digest."""
        with self.path(digest).open("rb") as file:
            file.seek(offset)
            data = file.read() if length is None else file.read(length)
        if offset == 0 and length is None and sha256(data) != digest:
            raise CorruptArtifactError(f"artifact {digest} has other bytes than its name says")
        if length is not None and len(data) != length:
            raise CorruptArtifactError(f"artifact {digest} ends before {offset} + {length}")
        return data

    def link(self, digest: str, target: Path) -> None:
        """Let `target` be the artifact under another name, without a second copy where the file system can."""
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch = _scratch_path(target)
        try:
            os.link(self.path(digest), scratch)
        except OSError:
            write_durably(target, self.read(digest))
            return
        scratch.replace(target)
        scratch.unlink(missing_ok=True)  # replace() does nothing where both names are one file already


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


def _scratch_path(path: Path) -> Path:
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
