"""A store in a bucket of Amazon S3, or of a server that speaks its protocol.

A PUT is there whole or not at all, so no scratch names are needed. An artifact is put with
`If-None-Match: *`: of two writers one wins, and the other finds that its bytes are there already. A
version is a set of copies that the server makes, so that any Zarr reader opens it in the bucket.

`transport.objects` makes the requests and says which variables of the environment it reads.
"""

import errno
import hashlib
import random
from collections.abc import Iterator
from contextlib import suppress

from stickslip_schemas.base import is_sha256, sha256
from stickslip_schemas.store import (
    ARTIFACTS,
    DATASETS,
    VERSION,
    CorruptArtifactError,
    ShownVersion,
    Stored,
    artifact_name,
    shown_name,
    version_name,
)
from stickslip_schemas.transport.objects import RETRY_SECONDS, ObjectClient, RefusedError

PROBE_SECONDS = 5.0
"""How long a request of a probe is repeated [s]: a probe must tell at once."""

BLOCK_BYTES = 1 << 22
"""Size of the request that reads a block of an artifact [bytes]."""

LARGE_BYTES = 1_000_000
"""From this size on, the server is asked whether it has an artifact before it is sent [bytes]."""


class BucketStore:
    """Artifacts below `PREFIX/artifacts` of a bucket, and versions below `PREFIX/datasets`.

    See `Store`.
    """

    def __init__(
        self, bucket: str, prefix: str = "", *, retry_timeout: float | None = None
    ) -> None:
        """Open a store.

        Args:
            bucket: Name of the bucket.
            prefix: Path before all names.
            retry_timeout: How long a request is repeated while the server is busy or away [s].

        Raises:
            ValueError: Variables of the environment contradict each other.
        """
        seconds = RETRY_SECONDS if retry_timeout is None else retry_timeout
        self._objects = ObjectClient(bucket, prefix, retry_timeout=seconds)

    @property
    def place(self) -> str:
        """The URL of the store."""
        return self._objects.url

    @property
    def cache(self) -> None:
        """None: this store has no cache directory."""

    def publish(self, data: bytes) -> str:
        """Make `data` an artifact.

        One that exists already is compared by its entity tag, or else read.
        """
        digest = sha256(data)
        name = artifact_name(digest)
        # A large artifact is worth a question: its bytes may not have to travel.
        if len(data) < LARGE_BYTES or not self.exists(digest):
            try:
                self._objects.put(name, data, mode="create")
            except FileExistsError:
                pass
            else:
                return digest
        # The object under this name may be damaged.
        if not self._has_bytes(digest, data):
            self._objects.put(name, data, mode="overwrite")
        return digest

    def _has_bytes(self, digest: str, data: bytes) -> bool:
        """Return whether an artifact has the bytes `data`.

        The entity tag of an object that was put in one piece is its MD5, unless the server encrypts
        it with a key of its own [Amazon S3, API reference, Object]. Another tag decides nothing,
        and the object is read.
        """
        # The size alone decides most cases, and costs no reading.
        head = self._objects.head(artifact_name(digest))
        if head["size"] != len(data):
            return False
        tag = f'"{hashlib.md5(data, usedforsecurity=False).hexdigest()}"'
        return head["e_tag"] == tag or self.holds(digest, size=len(data))

    def read(self, digest: str, *, offset: int = 0, length: int | None = None) -> bytes:
        """Return an artifact's bytes, or some of them; see `Store`."""
        if offset != 0 or length is not None:
            rest = self.size(digest) - offset if length is None else length
            return self._read_part(digest, offset, rest)
        data = self._objects.get(artifact_name(digest))
        if sha256(data) != digest:
            raise CorruptArtifactError(f"artifact {digest} has other bytes than its name says")
        return data

    def _read_part(self, digest: str, start: int, length: int) -> bytes:
        part = b""
        # The server refuses a range that starts behind the end.
        with suppress(RefusedError):
            if length > 0:
                part = self._objects.get_range(artifact_name(digest), start, length)
        # A whole part is the usual case; only a short one needs the reason.
        if len(part) == length > 0:
            return part
        if self.size(digest) < start + length:
            raise CorruptArtifactError(f"artifact {digest} ends before {start} + {length}")
        if length > 0:
            raise OSError(
                errno.EIO, f"{self.place} did not send all that was asked for of artifact {digest}"
            )
        return part

    def stream(self, digest: str, start: int, stop: int) -> Iterator[bytes]:
        """Yield blocks, each of a request, so that a connection that breaks costs one block."""
        while start < stop:
            block = self._read_part(digest, start, min(BLOCK_BYTES, stop - start))
            start += len(block)
            yield block

    def size(self, digest: str) -> int:
        """Return the size of an artifact [bytes]."""
        return int(self._objects.head(artifact_name(digest))["size"])

    def exists(self, digest: str, *, size: int = 0) -> bool:
        """Return whether there is an artifact of at least `size` bytes."""
        try:
            return self.size(digest) >= size
        except FileNotFoundError:
            return False

    def holds(self, digest: str, *, size: int | None = None) -> bool:
        """Return whether an artifact has the digest that names it; it is read."""
        try:
            actual_size = self.size(digest)
            if size is not None and size != actual_size:
                return False
            digester = hashlib.sha256()
            for block in self.stream(digest, 0, actual_size):
                digester.update(block)
        except (FileNotFoundError, CorruptArtifactError):  # deleted or cut while it was read
            return False
        return digester.hexdigest() == digest

    def delete(self, name: str) -> None:
        """Delete an artifact."""
        self._objects.delete([artifact_name(name)])

    def stored(self) -> Iterator[Stored]:
        """Yield the artifacts.

        A bucket has no leftovers. It does not know which artifacts versions show, because they
        show copies.
        """
        for item in self._objects.list_objects(f"{ARTIFACTS}/"):
            # Objects of somebody else may lie below the prefix.
            digest = item["path"].rpartition("/")[2]
            if is_sha256(digest) and item["path"] == artifact_name(digest):
                modified_at = item["last_modified"].timestamp()
                yield Stored(digest, item["size"], modified_at, is_shown=False)

    def show(self, digest: str, dataset: str, version: int, path: str) -> None:
        """Let a version show a copy of an artifact at `path`."""
        self._objects.copy(artifact_name(digest), shown_name(dataset, version, path))

    def shows(self, digest: str, dataset: str, version: int, path: str) -> bool:
        """Return whether a version shows the bytes of `digest` at `path`; they are read."""
        name = shown_name(dataset, version, path)
        artifact_name(digest)  # raises ValueError for a bad digest
        try:
            return sha256(self._objects.get(name)) == digest
        except FileNotFoundError:
            return False

    def read_shown(self, dataset: str, version: int, path: str) -> bytes:
        """Return the bytes that a version shows at `path`, unchecked."""
        return self._objects.get(shown_name(dataset, version, path))

    def versions(self, path: str) -> Iterator[ShownVersion]:
        """Yield the versions that show a file at `path`."""
        for dataset in self._objects.folders(DATASETS):
            for folder in self._objects.folders(f"{DATASETS}/{dataset}"):
                if VERSION.fullmatch(folder) is None:
                    continue
                version = int(folder[1:])
                try:
                    head = self._objects.head(shown_name(dataset, version, path))
                except FileNotFoundError:
                    continue
                yield ShownVersion(dataset, version, head["last_modified"].timestamp())

    def version_files(self) -> Iterator[tuple[str, int, str]]:
        """Yield the files that versions show: dataset, version and path."""
        for item in self._objects.list_objects(f"{DATASETS}/"):
            dataset, _, rest = item["path"].removeprefix(f"{DATASETS}/").partition("/")
            version, _, path = rest.partition("/")
            # Objects of somebody else may lie below the prefix.
            if path and VERSION.fullmatch(version):
                yield dataset, int(version[1:]), path

    def hide(self, dataset: str, version: int) -> None:
        """Let a version show nothing any more."""
        copies = self._objects.list_objects(f"{version_name(dataset, version)}/")
        self._objects.delete([item["path"] for item in copies])

    def is_shown(self, dataset: str, version: int) -> bool:
        """Return whether a version shows anything."""
        return bool(self._objects.list_objects(f"{version_name(dataset, version)}/"))

    def disk_usage(self) -> None:
        """Return None: a bucket has no limit."""

    def probe(self) -> None:
        """Write a small object and delete it; raise OSError if that fails."""
        # A new name each time: two coordinators may probe at once.
        client = self._objects.with_retry_timeout(PROBE_SECONDS)
        name = f".probe-{random.randbytes(8).hex()}"
        client.put(name, b"probe", mode="overwrite")
        client.delete([name])
