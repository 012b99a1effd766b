"""One client for the objects of a bucket of Amazon S3, or of a server that speaks its protocol.

The Rust crate `object_store` makes the requests. It repeats them after 5xx, and after a broken
connection where a second attempt can do no harm. No request of ours can do harm, because the name
of an object says what it holds. So this client repeats the rest.

Region, endpoint and credentials come from the variables that all S3 programs know: `AWS_REGION`,
`AWS_ENDPOINT_URL`, `AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, or from the machine's role.
`AWS_ALLOW_HTTP=true` allows an endpoint without TLS.
"""

import errno
import os
import random
import time
from collections.abc import Callable
from datetime import timedelta
from functools import partial
from http import HTTPStatus
from typing import Any, Literal, TypeVar

import obstore
import obstore.exceptions
import obstore.store

from stickslip_schemas.transport.proxies import object_store_options

RETRY_SECONDS = 60.0
"""How long a request is repeated while the server is busy or away [s]."""

DELETE_SECONDS = 5.0
"""How long a request that deletes one object may take [s]."""

_REQUEST_SECONDS = 300.0
"""How long one request may take, with its body [s]."""
_RETRY_TIMEOUTS_A_REQUEST = 5.0
"""One request ends after so many times the time for repetitions, if that is shorter."""
_FIRST_PAUSE_SECONDS = 0.1
_LONGEST_PAUSE_SECONDS = 5.0

_SIGNATURE_MINUTES = 5
"""How long a signed URL can be used [min]."""

_FINAL_STATUSES = (400, 405, 411, 412, 413, 414, 416, 501)
_REFUSALS = ("builder error", *(f"status code: {status}" for status in _FINAL_STATUSES))
"""Words of errors that come again, however often the request is made."""

T = TypeVar("T")


class RefusedError(OSError):
    """The server will never do that."""


class OversizeError(OSError):
    """An object is larger than the caller allows."""


class _BusyError(Exception):
    """The server asks to try again."""


class ObjectClient:
    """The objects below a prefix of a bucket.

    Methods raise FileNotFoundError for an object that does not exist, PermissionError if the server
    does not allow the request, RefusedError if it never will fulfil it, and another OSError if it
    cannot be reached or is busy for too long.
    """

    def __init__(
        self, bucket: str, prefix: str = "", *, retry_timeout: float = RETRY_SECONDS
    ) -> None:
        """Make a client; nothing is asked yet.

        Args:
            bucket: Name of the bucket.
            prefix: Path before the names of all objects.
            retry_timeout: How long a request is repeated [s].

        Raises:
            ValueError: Variables of the environment contradict each other.
        """
        self.url = f"s3://{bucket}/{prefix}".rstrip("/")
        self.retry_timeout = retry_timeout
        self._bucket = bucket
        self._prefix = prefix
        self._deletes_many = True
        """False once the server has refused the request that deletes many objects."""
        timeout = timedelta(
            seconds=min(_REQUEST_SECONDS, retry_timeout * _RETRY_TIMEOUTS_A_REQUEST)
        )
        # `object_store` reads these two itself only if it is given no options of a client.
        allow_http = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true", "yes")
        endpoint = _endpoint(bucket)
        client_options: Any = {
            "timeout": timeout,
            "allow_http": allow_http,
            **object_store_options(endpoint),
        }
        try:
            self._store = obstore.store.S3Store(
                bucket,
                prefix=prefix or None,
                client_options=client_options,
                retry_config={"retry_timeout": timedelta(seconds=retry_timeout)},
            )
        except obstore.exceptions.BaseError as error:
            raise ValueError(f"the store {self.url} cannot be opened: {_summary(error)}") from error

    def get(self, name: str, *, limit: int | None = None) -> bytes:
        """Return an object.

        Raises:
            OversizeError: It has more than `limit` bytes.
        """

        def read() -> bytes:
            # The size comes with the header, before the body is read.
            result = obstore.get(self._store, name)
            size = result.meta["size"]
            if limit is not None and size > limit:
                raise OversizeError(
                    errno.EFBIG, f"{self.url}/{name} has {size} bytes, and at most {limit} fit"
                )
            return bytes(result.bytes().to_bytes())

        return self._repeat(read)

    def get_range(self, name: str, start: int, length: int) -> bytes:
        """Return up to `length` bytes of an object from `start`, fewer at its end."""
        return self._repeat(
            lambda: bytes(
                obstore.get_range(self._store, name, start=start, length=length).to_bytes()
            )
        )

    def head(self, name: str) -> Any:
        """Return the metadata of an object: `size`, `e_tag` and `last_modified`."""
        return self._repeat(lambda: obstore.head(self._store, name))

    def put(self, name: str, data: bytes, *, mode: Literal["create", "overwrite"]) -> None:
        """Put an object, which is there whole or not at all.

        A server answers 409 to one of two conditional PUTs that run at once, or to one beside a
        DELETE. Then the object may be there or not, and the PUT is repeated until it is.

        Raises:
            FileExistsError: The mode is `create`, and there is an object of this name.
        """
        self._repeat(partial(self._put, name, data, mode))

    def _put(self, name: str, data: bytes, mode: Literal["create", "overwrite"]) -> None:
        try:
            obstore.put(self._store, name, data, mode=mode, use_multipart=False)
        except obstore.exceptions.AlreadyExistsError as error:
            try:
                obstore.head(self._store, name)
            except FileNotFoundError:
                raise _BusyError("another writer puts the object") from error
            raise FileExistsError(errno.EEXIST, "there already", name) from error
        except FileNotFoundError as error:
            raise OSError(errno.ESTALE, f"the bucket of {self.url} does not exist") from error

    def copy(self, source: str, target: str) -> None:
        """Let the server copy an object."""
        self._repeat(lambda: obstore.copy(self._store, source, target))

    def list_objects(self, prefix: str) -> list[Any]:
        """Return the metadata of the objects below a prefix, ordered by name."""

        def read_pages() -> list[Any]:
            objects: list[Any] = []
            for page in obstore.list(self._store, prefix=prefix):
                objects.extend(page)
            return objects

        return self._repeat(read_pages)

    def folders(self, prefix: str) -> list[str]:
        """Return the names of the folders directly below a prefix, in order."""
        listing = self._repeat(lambda: obstore.list_with_delimiter(self._store, prefix))
        return sorted(path.rstrip("/").rpartition("/")[2] for path in listing["common_prefixes"])

    def delete(self, names: list[str]) -> None:
        """Delete objects, one by one if the server has no request that deletes many.

        An object that does not exist is no error.
        """
        # Some servers have no such request, which shows with the first one.
        if names and self._deletes_many:
            try:
                self._repeat(lambda: obstore.delete(self._store, names))
            except RefusedError:
                self._deletes_many = False
            else:
                return
        for name in names:
            self._repeat(partial(self._delete_one, name))

    def _delete_one(self, name: str) -> None:
        """Delete an object by a request of its own, which `obstore` signs, but does not make."""
        from stickslip_schemas.transport.http import (  # needs the extra `http`
            AnswerError,
            HttpClient,
            TransportError,
        )

        url = obstore.sign(self._store, "DELETE", name, timedelta(minutes=_SIGNATURE_MINUTES))
        client = HttpClient(retry_timeout=0.0)
        try:
            status = client.request("DELETE", url).status_code
        except (TransportError, AnswerError) as error:
            raise _BusyError(str(error)) from error
        finally:
            client.close()
        if status >= HTTPStatus.BAD_REQUEST and status != HTTPStatus.NOT_FOUND:
            raise _BusyError(f"status code: {status}")

    def with_retry_timeout(self, retry_timeout: float) -> "ObjectClient":
        """Return a client of the same objects that gives up after `retry_timeout` seconds."""
        client = ObjectClient(
            self._bucket, self._prefix, retry_timeout=min(self.retry_timeout, retry_timeout)
        )
        client._deletes_many = self._deletes_many
        return client

    def _repeat(self, request: Callable[[], T]) -> T:
        """Repeat a request until the server answers or the time for repetitions is over."""
        end = time.monotonic() + self.retry_timeout
        pause = _FIRST_PAUSE_SECONDS
        while True:
            try:
                return request()
            except (
                obstore.exceptions.PermissionDeniedError,
                obstore.exceptions.UnauthenticatedError,
            ) as error:
                raise PermissionError(errno.EACCES, f"{self.url}: {_summary(error)}") from error
            except (_BusyError, obstore.exceptions.BaseError) as error:
                # The crate tells its reasons in words only.
                message = f"{self.url}: {_summary(error)}"
                if any(words in str(error) for words in _REFUSALS):
                    raise RefusedError(errno.EINVAL, message) from error
                if time.monotonic() + pause > end:
                    raise OSError(errno.EHOSTUNREACH, message) from error
            # Many workers wait at once, so each waits another time.
            time.sleep(pause * random.uniform(0.5, 1.0))
            pause = min(2 * pause, _LONGEST_PAUSE_SECONDS)


def _endpoint(bucket: str) -> str:
    """Return the URL that requests go to, as far as the choice of a proxy depends on it."""
    for variable in ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"):
        endpoint = os.environ.get(variable)
        if endpoint:
            return endpoint
    return f"https://{bucket}.s3.amazonaws.com"


def _summary(error: Exception) -> str:
    """Return the first line of an error, which names the fault.

    The others are the structure of a Rust value.
    """
    return str(error).partition("\n")[0]
