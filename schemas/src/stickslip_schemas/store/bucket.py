"""A store in a bucket of Amazon S3, or of a server that speaks its protocol, through the Rust crate
`object_store`.

A PUT is there whole or not at all, so no scratch names are needed. An artifact is put with
`If-None-Match: *`: of two writers one wins, and the other finds that its bytes are there already. A
version is a set of copies that the server makes, so that any Zarr reader opens it in the bucket.

Region, endpoint and credentials come from the variables that all S3 programs know: `AWS_REGION`,
`AWS_ENDPOINT_URL`, `AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, or from the machine's role.
`AWS_ALLOW_HTTP=true` allows an endpoint without TLS.
"""

import errno
import hashlib
import os
import random
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import timedelta
from functools import partial
from http import HTTPStatus
from typing import Any, TypeVar

import obstore
import obstore.exceptions
import obstore.store

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

PATIENCE = 60.0
"""How long a request is tried again while the server is busy or away [s]."""

PROBE_PATIENCE = 5.0
"""The same of a probe [s], which is to tell at once."""

BLOCK = 1 << 22
"""How much of an artifact one request of a stream asks for [bytes]."""

LARGE = 1_000_000
"""From this size on, the server is asked whether it has an artifact before it is sent [bytes]."""

_REQUEST_TIMEOUT = timedelta(minutes=5)
_FIRST_WAIT, _LONGEST_WAIT = 0.1, 5.0

R = TypeVar("R")


class BucketStore:
    """Artifacts below `PREFIX/artifacts` and versions below `PREFIX/datasets` of a bucket; see
    `Store`.
    """

    def __init__(self, bucket: str, prefix: str = "", *, patience: float | None = None) -> None:
        """Open a store; raise ValueError where variables of the environment contradict each other."""
        self.place = f"s3://{bucket}/{prefix}".rstrip("/")
        self._bucket, self._prefix = bucket, prefix
        self._patience = PATIENCE if patience is None else patience
        self._deletes_many = True
        """False once the server has refused the request that deletes many objects."""
        try:
            self._objects = obstore.store.S3Store(
                bucket,
                prefix=prefix or None,
                client_options={
                    "timeout": min(_REQUEST_TIMEOUT, timedelta(seconds=self._patience * 5)),
                    # What `object_store` reads where it is given no options of a client.
                    "allow_http": os.environ.get("AWS_ALLOW_HTTP", "").lower()
                    in ("1", "true", "yes"),
                },
                retry_config={"retry_timeout": timedelta(seconds=self._patience)},
            )
        except obstore.exceptions.BaseError as error:
            raise ValueError(
                f"the store {self.place} cannot be opened: {_summary(error)}"
            ) from error

    @property
    def cache(self) -> None:
        """None: this store has no cache directory."""

    def publish(self, data: bytes) -> str:
        """An artifact that is there already is compared by its entity tag, or else read."""
        digest = sha256(data)
        name = artifact_name(digest)
        if len(data) < LARGE or not self.exists(digest):
            try:
                self._put(name, data, mode="create")
                return digest
            except FileExistsError:
                pass
        if not self._is_there(digest, data):
            self._put(name, data, mode="overwrite")
        return digest

    def _put(self, name: str, data: bytes, *, mode: Any) -> None:
        """Put an object; raise FileExistsError where it must not exist and does.

        A server answers 409 to one of two conditional PUTs that run at once, or to one beside a
        DELETE. Then the object may be there or not, and the PUT is tried again until it is.
        """

        def put() -> None:
            try:
                obstore.put(self._objects, name, data, mode=mode, use_multipart=False)
            except obstore.exceptions.AlreadyExistsError as error:
                try:
                    obstore.head(self._objects, name)
                except FileNotFoundError:
                    raise _BusyError("another writer is at it") from error
                raise FileExistsError(errno.EEXIST, "there already", name) from error
            except FileNotFoundError as error:
                raise OSError(errno.ESTALE, f"the bucket of {self.place} does not exist") from error

        self._tried(put)

    def _is_there(self, digest: str, data: bytes) -> bool:
        """Return whether an artifact has the bytes `data`.

        The entity tag of an object that was put in one piece is its MD5, unless the server encrypts
        it with a key of its own [Amazon S3, API reference, Object]. Another tag decides nothing,
        and the object is read.
        """
        head = self._head(artifact_name(digest))
        if head["size"] != len(data):
            return False
        tag = f'"{hashlib.md5(data, usedforsecurity=False).hexdigest()}"'
        return head["e_tag"] == tag or self.holds(digest, size=len(data))

    def read(self, digest: str, *, offset: int = 0, length: int | None = None) -> bytes:
        if offset != 0 or length is not None:
            return self._read_part(
                digest, offset, self.size(digest) - offset if length is None else length
            )
        data = self._get(artifact_name(digest))
        if sha256(data) != digest:
            raise CorruptArtifactError(f"artifact {digest} has other bytes than its name says")
        return data

    def _read_part(self, digest: str, start: int, length: int) -> bytes:
        name, part = artifact_name(digest), b""
        with suppress(_RefusedError):  # it starts behind the end
            if length > 0:
                part = self._tried(
                    lambda: obstore.get_range(
                        self._objects, name, start=start, length=length
                    ).to_bytes()
                )
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
        """Each block is a request, so that a connection that breaks costs one block."""
        while start < stop:
            block = self._read_part(digest, start, min(BLOCK, stop - start))
            start += len(block)
            yield block

    def size(self, digest: str) -> int:
        return int(self._head(artifact_name(digest))["size"])

    def exists(self, digest: str, *, size: int = 0) -> bool:
        try:
            return self.size(digest) >= size
        except FileNotFoundError:
            return False

    def holds(self, digest: str, *, size: int | None = None) -> bool:
        try:
            found = self.size(digest)
            if size not in (None, found):
                return False
            hashed = hashlib.sha256()
            for block in self.stream(digest, 0, found):
                hashed.update(block)
        except (FileNotFoundError, CorruptArtifactError):  # deleted or cut while it was read
            return False
        return hashed.hexdigest() == digest

    def delete(self, name: str) -> None:
        self._delete([artifact_name(name)])

    def stored(self) -> Iterator[Stored]:
        """A bucket has no leftovers, and does not know what versions show: they show copies."""
        for found in self._list(f"{ARTIFACTS}/"):
            digest = found["path"].rpartition("/")[2]
            if is_sha256(digest) and found["path"] == artifact_name(digest):
                yield Stored(
                    digest, found["size"], found["last_modified"].timestamp(), is_shown=False
                )

    def show(self, digest: str, dataset: str, version: int, path: str) -> None:
        source, target = artifact_name(digest), shown_name(dataset, version, path)
        self._tried(lambda: obstore.copy(self._objects, source, target))

    def shows(self, digest: str, dataset: str, version: int, path: str) -> bool:
        name = shown_name(dataset, version, path)
        artifact_name(digest)
        try:
            return sha256(self._get(name)) == digest
        except FileNotFoundError:
            return False

    def read_shown(self, dataset: str, version: int, path: str) -> bytes:
        return self._get(shown_name(dataset, version, path))

    def versions(self, path: str) -> Iterator[ShownVersion]:
        for dataset in self._folders(DATASETS):
            for version in self._folders(f"{DATASETS}/{dataset}"):
                if VERSION.fullmatch(version) is None:
                    continue
                name = shown_name(dataset, int(version[1:]), path)
                try:
                    head = self._head(name)
                except FileNotFoundError:
                    continue
                yield ShownVersion(dataset, int(version[1:]), head["last_modified"].timestamp())

    def hide(self, dataset: str, version: int) -> None:
        self._delete([found["path"] for found in self._list(f"{version_name(dataset, version)}/")])

    def is_shown(self, dataset: str, version: int) -> bool:
        return bool(self._list(f"{version_name(dataset, version)}/"))

    def room(self) -> None:
        """Return None: a bucket has no limit."""

    def probe(self) -> None:
        quick = BucketStore(
            self._bucket, self._prefix, patience=min(self._patience, PROBE_PATIENCE)
        )
        quick._deletes_many = self._deletes_many
        name = f".probe-{random.randbytes(8).hex()}"
        quick._put(name, b"probe", mode="overwrite")
        quick._delete([name])
        self._deletes_many = quick._deletes_many

    def _head(self, name: str) -> Any:
        return self._tried(lambda: obstore.head(self._objects, name))

    def _get(self, name: str) -> bytes:
        return self._tried(lambda: obstore.get(self._objects, name).bytes().to_bytes())

    def _list(self, prefix: str) -> list[Any]:
        """Return the objects below a prefix, ordered by name."""
        return self._tried(
            lambda: [found for page in obstore.list(self._objects, prefix=prefix) for found in page]
        )

    def _folders(self, prefix: str) -> list[str]:
        found = self._tried(lambda: obstore.list_with_delimiter(self._objects, prefix))
        return sorted(name.rstrip("/").rpartition("/")[2] for name in found["common_prefixes"])

    def _delete(self, names: list[str]) -> None:
        """Delete objects, one by one where the bucket has no request that deletes many."""
        if names and self._deletes_many:
            try:
                return self._tried(lambda: obstore.delete(self._objects, names))
            except _RefusedError:
                self._deletes_many = False
        for name in names:
            self._tried(partial(self._delete_one, name))
        return None

    def _delete_one(self, name: str) -> None:
        """Delete an object by a request of its own, which `obstore` signs, but does not make."""
        url = obstore.sign(self._objects, "DELETE", name, timedelta(minutes=5))
        try:
            urllib.request.urlopen(
                urllib.request.Request(url, method="DELETE"), timeout=PROBE_PATIENCE
            ).close()
        except urllib.error.HTTPError as error:
            if error.code != HTTPStatus.NOT_FOUND:
                raise _BusyError(f"status code: {error.code}") from error
        except OSError as error:
            raise _BusyError(str(error)) from error

    def _tried(self, request: Callable[[], R]) -> R:
        """Make a request until the server answers or patience ends.

        `object_store` itself tries again after 5xx, and after a broken connection where a second
        try can do no harm. None of ours can: what an artifact holds is known by its name. So the
        rest is tried again here.

        Raises: PermissionError: The server does not let us. _RefusedError: The server refuses the
            request, whenever it is made. OSError: The server cannot be reached, or is busy for too
            long; `is_unavailable` is true of it.
        """
        end, wait = time.monotonic() + self._patience, _FIRST_WAIT
        while True:
            try:
                return request()
            except (
                obstore.exceptions.PermissionDeniedError,
                obstore.exceptions.UnauthenticatedError,
            ) as error:
                raise PermissionError(errno.EACCES, f"{self.place}: {_summary(error)}") from error
            except (_BusyError, obstore.exceptions.BaseError) as error:
                if any(sign in str(error) for sign in _REFUSALS):
                    raise _RefusedError(errno.EINVAL, f"{self.place}: {_summary(error)}") from error
                if time.monotonic() + wait > end:
                    raise OSError(errno.EHOSTUNREACH, f"{self.place}: {_summary(error)}") from error
            time.sleep(wait * random.uniform(0.5, 1.0))
            wait = min(2 * wait, _LONGEST_WAIT)


_REFUSALS = (
    "builder error",
    *(f"status code: {status}" for status in (400, 405, 411, 412, 413, 414, 416, 501)),
)
"""What an error says that comes again, however often the request is made."""


class _BusyError(Exception):
    """The server asks to try again."""


class _RefusedError(OSError):
    """The server will never do what it was asked for."""


def _summary(error: Exception) -> str:
    """Return the first line of an error, which says what failed.

    The others are the structure of a Rust value.
    """
    return str(error).partition("\n")[0]
