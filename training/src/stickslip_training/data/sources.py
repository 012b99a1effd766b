"""Where a dataset's bytes come from: a directory, a bucket, or an HTTP server that answers range
requests; what can be wrong with them.

A source keeps nothing open that two processes could fight over: a file is opened for each read, and
an HTTP client belongs to the process that made it. So a source can be pickled and survives a fork.
"""

import hashlib
import os
import re
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from stickslip_schemas.format.codecs import CorruptChunkError
from stickslip_schemas.format.manifest import MANIFEST_NAME, FileEntry
from stickslip_schemas.installation import install_hint

API_KEY_VARIABLE = "STICKSLIP_API_KEY"
"""Environment variable with the key that is sent to a server where none is given."""


class DatasetError(Exception):
    """The base of everything that reading a dataset raises on purpose."""


class InvalidDatasetError(DatasetError, ValueError):
    """The manifest or the metadata contradict the contract, or each other."""


class MissingFileError(DatasetError, FileNotFoundError):
    """A file that belongs to the dataset is not there."""


class CorruptDataError(DatasetError, CorruptChunkError):
    """Bytes are not what a size, a checksum or a digest says they are."""


class RejectedSampleError(DatasetError, LookupError):
    """The sample was rejected when the dataset was made."""


class SourceError(DatasetError, OSError):
    """The server does not answer, or not with the requested data."""


class Source(ABC):
    """The files of one dataset version."""

    @abstractmethod
    def fetch(self, path: str, part: range | None = None) -> tuple[bytes, int | None]:
        """Return the bytes of a file, or those of a part of it, and the size of the file if it is
        known.

        Raises MissingFileError where there is no such file.
        """

    def read_manifest(self) -> bytes:
        """Return the manifest's bytes."""
        try:
            return self.fetch(MANIFEST_NAME)[0]
        except MissingFileError as error:
            raise MissingFileError(f"{error}: this is no committed dataset version") from None

    def read(self, file: FileEntry, offset: int = 0, length: int | None = None) -> bytes:
        """Return `length` bytes from `offset`, or all of the file, whose size must be that of the
        manifest.
        """
        length = file.size - offset if length is None else length
        try:
            data, size = self.fetch(
                file.path, None if length == file.size else range(offset, offset + length)
            )
        except MissingFileError as error:
            raise MissingFileError(f"{error}, and the manifest says it is") from None
        if size not in (None, file.size):
            raise CorruptDataError(
                f"{self}/{file.path} has {size} bytes, and the manifest says {file.size}"
            )
        if len(data) != length:
            raise CorruptDataError(
                f"{self}/{file.path} sent {len(data)} bytes, and {length} were expected"
            )
        return data

    def digest(self, file: FileEntry) -> str | None:
        """Return the SHA-256 of the file; None if the whole file would have to be fetched."""
        return None

    def close(self) -> None:  # noqa: B027
        """Close connections; the source can be read again afterwards."""


def open_source(source: str | os.PathLike[str], *, api_key: str | None = None) -> "Source":
    """Return the source that a path or a URL means."""
    text = os.fspath(source)
    if re.match(r"https?://", text):
        return HttpSource(
            text, api_key=api_key if api_key is not None else os.environ.get(API_KEY_VARIABLE)
        )
    if text.startswith("s3://"):
        return BucketSource(text)
    return DirectorySource(Path(text))


class DirectorySource(Source):
    """A dataset version in a directory."""

    def __init__(self, root: Path) -> None:
        self._root = str(root)

    def __str__(self) -> str:
        return self._root

    def fetch(self, path: str, part: range | None = None) -> tuple[bytes, int | None]:
        try:
            with Path(self._root, path).open("rb") as file:
                file.seek(0 if part is None else part.start)
                return file.read(-1 if part is None else len(part)), os.fstat(file.fileno()).st_size
        except (FileNotFoundError, NotADirectoryError):
            raise MissingFileError(f"{self}/{path} is not there") from None

    def digest(self, file: FileEntry) -> str | None:
        with Path(self._root, file.path).open("rb", buffering=0) as opened:
            return hashlib.file_digest(opened, "sha256").hexdigest()


class _RemoteSource(Source):
    """A URL with a client, which belongs to the process that made it."""

    def __init__(self, url: str) -> None:
        self._url = url.rstrip("/")
        self._client: Any = None
        self._pid = 0

    def __str__(self) -> str:
        return self._url

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_client": None, "_pid": 0}


class BucketSource(_RemoteSource):
    """A dataset version in an S3 bucket: `s3://BUCKET/PREFIX/datasets/<id>/v<n>`.

    Region, endpoint and credentials are those of the variables `AWS_...` of the environment. A read
    is one request. The client has threads, which a fork does not have: a DataLoader with workers
    needs `multiprocessing_context="spawn"`.
    """

    PATIENCE = timedelta(seconds=60)

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        if not parts.netloc or parts.query or parts.fragment:
            raise ValueError(
                f"a version in a bucket is s3://BUCKET/PREFIX/datasets/ID/vN, and the source is {url!r}"
            )
        super().__init__(url)
        self._bucket, self._prefix = parts.netloc, unquote(parts.path).strip("/")

    def fetch(self, path: str, part: range | None = None) -> tuple[bytes, int | None]:
        if part is None:
            return self._asked(
                path, lambda obstore, objects: obstore.get(objects, path).bytes().to_bytes()
            ), None
        within = {"start": part.start, "end": part.stop}
        return self._asked(
            path, lambda obstore, objects: obstore.get_range(objects, path, **within).to_bytes()
        ), None

    def close(self) -> None:
        self._client = None

    def _asked(self, name: str, request: Callable[[Any, Any], bytes]) -> bytes:
        try:
            import obstore
        except ModuleNotFoundError as error:
            raise SourceError(
                f"{self} needs obstore, which is not installed: "
                + install_hint("stickslip-training", "s3")
            ) from error
        if self._client is not None and self._pid != os.getpid():
            raise SourceError(
                f'{self} cannot be read after a fork: give the DataLoader multiprocessing_context="spawn"'
            )
        try:
            if self._client is None:
                retries: Any = {"retry_timeout": self.PATIENCE}
                self._client = obstore.store.S3Store(
                    self._bucket, prefix=self._prefix or None, retry_config=retries
                )
                self._pid = os.getpid()
            return bytes(request(obstore, self._client))
        except FileNotFoundError:
            raise MissingFileError(f"{self}/{name} is not there") from None
        except obstore.exceptions.BaseError as error:
            raise SourceError(
                f"{self}/{name} cannot be read: {str(error).splitlines()[0]}"
            ) from error


class HttpSource(_RemoteSource):
    """A dataset version behind a URL.

    Either a version of the service, `.../v1/datasets/<id>/versions/<n>` (with or without `/files`
    or `/manifest`), or any URL below which the dataset's files lie, `manifest.json` among them.
    """

    TRIES = 4
    _RETRIED_STATUSES = frozenset({429, 500, 502, 503, 504})

    def __init__(self, url: str, *, api_key: str | None = None) -> None:
        url = url.rstrip("/")
        version = re.match(r"(.*/versions/\d+)(/files|/manifest)?$", url)
        super().__init__(f"{version[1]}/files" if version else url)
        self._api_key = api_key

    def fetch(self, path: str, part: range | None = None) -> tuple[bytes, int | None]:
        url, asked = f"{self}/{path}", "" if part is None else f"{part.start}-{part.stop - 1}"
        response = self._get(url, {"Range": f"bytes={asked}"} if asked else {})
        status, expected = response.status_code, 206 if asked else 200
        if status == 404:
            raise MissingFileError(f"{url} is not there")
        if status == 416:
            raise CorruptDataError(f"{url} ends before bytes {asked}")
        if status != expected:
            hint = ": it does not serve ranges" if status == 200 else ""
            raise SourceError(f"{url} answered {status}, and {expected} was expected{hint}")
        data = bytes(response.content)
        if not asked:
            return data, len(data)
        sent = re.fullmatch(r"bytes (\d+-\d+)/(\d+)", response.headers.get("Content-Range", ""))
        if sent is None or sent[1] != asked:
            raise CorruptDataError(
                f"{url} sent {sent and sent[0]}, and bytes {asked} were expected"
            )
        return data, int(sent[2])

    def close(self) -> None:
        if self._client is not None and self._pid == os.getpid():
            self._client.close()
        self._client = None

    def _get(self, url: str, headers: dict[str, str]) -> Any:
        """GET with a few tries: a server that restarts or is busy is no reason to lose an epoch."""
        import httpx  # only who reads over HTTP needs it

        if self._client is None or self._pid != os.getpid():
            # A fork shares the parent's sockets: the child must not use them, nor close them.
            headers_of_all = {
                "Accept-Encoding": "identity"
            }  # ranges are of the file, not of a compressed form of it
            if self._api_key:
                headers_of_all["Authorization"] = f"Bearer {self._api_key}"
            self._client = httpx.Client(headers=headers_of_all, timeout=30.0, follow_redirects=True)
            self._pid = os.getpid()
        for attempt in range(self.TRIES):
            try:
                response = self._client.get(url, headers=headers)
            except httpx.TransportError as error:
                if attempt == self.TRIES - 1:
                    raise SourceError(f"{url} does not answer: {error!r}") from error
            except httpx.InvalidURL as error:
                raise SourceError(f"{url} is no URL: {error}") from error
            else:
                if response.status_code not in self._RETRIED_STATUSES or attempt == self.TRIES - 1:
                    return response
            time.sleep(0.1 * 4**attempt)
        raise AssertionError("unreachable")
