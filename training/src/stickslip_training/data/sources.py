"""Sources of a dataset's bytes: a directory, a bucket, or an HTTP server that answers ranges.

A source keeps nothing open that two processes could share by accident. A file is opened for each
read, and a client belongs to the process that made it. So a source can be pickled and survives a
fork.
"""

import hashlib
import os
import re
from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import unquote, urlsplit

from stickslip_schemas.format.codecs import CorruptChunkError
from stickslip_schemas.format.manifest import MANIFEST_NAME, FileEntry
from stickslip_schemas.installation import install_hint
from stickslip_schemas.transport.addresses import (
    API_KEY_VARIABLE,
    URL_VARIABLE,
    api_key_for,
    api_key_of_environment,
    check_url,
    coordinator_url,
)
from stickslip_schemas.transport.limits import DOCUMENT_BYTES, check_values
from stickslip_schemas.transport.proxies import through

if TYPE_CHECKING:
    from stickslip_schemas.transport.objects import ObjectClient

BLOCK_BYTES = 16 * 2**20
"""Size of the blocks in which a file is read for its digest [bytes]."""
READER_RETRY_SECONDS = 10.0
"""How long a failed request of a reader is repeated [s]: a server that restarts costs no epoch."""


class DatasetError(Exception):
    """The base of every error that reading a dataset raises on purpose."""


class InvalidDatasetError(DatasetError, ValueError):
    """The manifest or the metadata contradict the contract, or each other."""


class MissingFileError(DatasetError, FileNotFoundError):
    """A file that belongs to the dataset does not exist."""


class CorruptDataError(DatasetError, CorruptChunkError):
    """Bytes do not have the size, the checksum or the digest that they should have."""


class RejectedSampleError(DatasetError, LookupError):
    """The sample was rejected when the dataset was made."""


class SourceError(DatasetError, OSError):
    """The server does not answer, or not with the requested data."""


class Fetched(NamedTuple):
    """Bytes of a file."""

    data: bytes
    file_size: int | None
    """Size of the whole file [bytes]; None if the source did not say it."""


class Source(ABC):
    """The files of one dataset version."""

    @abstractmethod
    def fetch(
        self, path: str, part: range | None = None, *, limit: int = DOCUMENT_BYTES
    ) -> Fetched:
        """Return the bytes of a file, or of a part of it.

        Args:
            path: Path of the file in the version.
            part: Bytes to return; None for the whole file.
            limit: Largest file that is read whole [bytes].

        Raises:
            MissingFileError: There is no such file.
            CorruptDataError: The file ends before the part, or is larger than `limit`.
            SourceError: The server does not answer.
        """

    def read_manifest(self) -> bytes:
        """Return the manifest's bytes."""
        try:
            manifest = self.fetch(MANIFEST_NAME).data
        except MissingFileError as error:
            raise MissingFileError(f"{error}: this is no committed dataset version") from None
        self._check_values(MANIFEST_NAME, manifest)
        return manifest

    def _check_values(self, path: str, document: bytes) -> None:
        """Raise CorruptDataError for a document whose parsing would fill the memory."""
        try:
            check_values(document)
        except ValueError as error:
            raise CorruptDataError(f"{self}/{path} {error}") from error

    def read(self, file: FileEntry, offset: int = 0, length: int | None = None) -> bytes:
        """Return `length` bytes from `offset`, or the rest of the file.

        Raises:
            CorruptDataError: The file has another size than the manifest says.
        """
        # A whole file is one plain request, and a part is a request with a range.
        count = file.size - offset if length is None else length
        is_whole = count == file.size
        part = None if is_whole else range(offset, offset + count)
        try:
            fetched = self.fetch(file.path, part, limit=file.size)
        except MissingFileError as error:
            raise MissingFileError(f"{error}, and the manifest says it is") from None
        if fetched.file_size not in (None, file.size):
            raise CorruptDataError(
                f"{self}/{file.path} has {fetched.file_size} bytes, and the manifest says "
                f"{file.size}"
            )
        if len(fetched.data) != count:
            raise CorruptDataError(
                f"{self}/{file.path} sent {len(fetched.data)} bytes, and {count} were expected"
            )
        return fetched.data

    def read_document(self, file: FileEntry) -> bytes:
        """Return a JSON document, a section of the manifest for example.

        Raises:
            CorruptDataError: It is larger than any document can be.
        """
        if file.size > DOCUMENT_BYTES:
            raise CorruptDataError(
                f"{self}/{file.path} has {file.size} bytes, and a document has at most "
                f"{DOCUMENT_BYTES}"
            )
        document = self.read(file)
        self._check_values(file.path, document)
        return document

    def computed_digest(self, file: FileEntry) -> str:
        """Return the SHA-256 of the file, which is read in blocks.

        Raises:
            CorruptDataError: The file has another size than the manifest says.
        """
        digester = hashlib.sha256()
        # The manifest of a hostile server may state any size, and memory must not follow from it.
        for offset in range(0, max(1, file.size), BLOCK_BYTES):
            length = min(BLOCK_BYTES, file.size - offset)
            digester.update(self.read(file, offset, length))
        return digester.hexdigest()

    def digest(self, file: FileEntry) -> str | None:
        """Return the SHA-256 of the file; None if the whole file would have to be fetched."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Close connections; the source can be read again afterwards."""


def open_source(source: str | os.PathLike[str], *, api_key: str | None = None) -> Source:
    """Return the source that a path or a URL means.

    Args:
        source: A directory, `http://...`, `https://...` or `s3://...`.
        api_key: Key for the server of the URL. Without it, the key of the environment is sent, but
            only to the coordinator that it belongs to.
    """
    text = os.fspath(source)
    if re.match(r"https?://", text):
        return HttpSource(text, api_key=api_key)
    if text.startswith("s3://"):
        return BucketSource(text)
    return DirectorySource(Path(text))


class DirectorySource(Source):
    """A dataset version in a directory."""

    def __init__(self, root: Path) -> None:
        self._root = str(root)

    def __str__(self) -> str:
        return self._root

    def fetch(
        self, path: str, part: range | None = None, *, limit: int = DOCUMENT_BYTES
    ) -> Fetched:
        """Return the bytes of a file, or of a part of it; see `Source`."""
        try:
            with Path(self._root, path).open("rb") as file:
                # Of the open file: the name may mean another file a moment later.
                size = os.fstat(file.fileno()).st_size
                if part is not None:
                    file.seek(part.start)
                    return Fetched(file.read(len(part)), size)
                if size > limit:
                    raise CorruptDataError(
                        f"{self}/{path} has {size} bytes, and at most {limit} are expected"
                    )
                return Fetched(file.read(), size)
        except (FileNotFoundError, NotADirectoryError):
            raise MissingFileError(f"{self}/{path} is not there") from None

    def digest(self, file: FileEntry) -> str | None:
        """Return the SHA-256 of the file."""
        with Path(self._root, file.path).open("rb", buffering=0) as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()

    def close(self) -> None:
        """Do nothing: no file stays open."""


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

    Region, endpoint and credentials are read from the variables `AWS_...` of the environment. A
    read is one request. The client has threads, which a fork does not have: a DataLoader with
    workers needs `multiprocessing_context="spawn"`.
    """

    RETRY_SECONDS = 60.0
    """How long a request is repeated while the bucket's server is busy or away [s]."""

    def __init__(self, url: str) -> None:
        """Make a source; nothing is asked yet.

        Raises:
            ValueError: The URL has no bucket, or has a query.
        """
        parts = urlsplit(url)
        if not parts.netloc or parts.query or parts.fragment:
            raise ValueError(
                "a version in a bucket is s3://BUCKET/PREFIX/datasets/ID/vN, and the source is "
                f"{url!r}"
            )
        super().__init__(url)
        self._bucket = parts.netloc
        self._prefix = unquote(parts.path).strip("/")

    def fetch(
        self, path: str, part: range | None = None, *, limit: int = DOCUMENT_BYTES
    ) -> Fetched:
        """Return the bytes of an object, or of a part of it; see `Source`."""
        objects = self._objects()
        try:
            if part is None:
                data = objects.get(path, limit=limit)
            else:
                data = objects.get_range(path, part.start, len(part))
        except FileNotFoundError:
            raise MissingFileError(f"{self}/{path} is not there") from None
        except OSError as error:
            raise SourceError(f"{self}/{path} cannot be read: {error.strerror}") from error
        return Fetched(data, None)

    def close(self) -> None:
        """Forget the client, which closes its connections."""
        self._client = None

    def _objects(self) -> "ObjectClient":
        try:
            from stickslip_schemas.transport.objects import ObjectClient
        except ModuleNotFoundError as error:
            raise SourceError(
                f"{self} needs obstore, which is not installed: "
                + install_hint("stickslip-training", "s3")
            ) from error
        # The threads of the client stayed in the parent process, and requests would hang.
        if self._client is not None and self._pid != os.getpid():
            raise SourceError(
                f"{self} cannot be read after a fork: give the DataLoader "
                'multiprocessing_context="spawn"'
            )
        if self._client is None:
            self._client = ObjectClient(
                self._bucket, self._prefix, retry_timeout=self.RETRY_SECONDS
            )
            self._pid = os.getpid()
        return self._client  # type: ignore[no-any-return]  # one attribute for both sources


class HttpSource(_RemoteSource):
    """A dataset version behind a URL.

    Either a version of the service, `.../v1/datasets/<id>/versions/<n>` (with or without `/files`
    or `/manifest`), or any URL below which the dataset's files lie, `manifest.json` among them.
    """

    def __init__(self, url: str, *, api_key: str | None = None) -> None:
        """Make a source; nothing is asked yet.

        Raises:
            ValueError: The URL names no server.
        """
        try:
            check_url(url)
        except ValueError as error:
            address = url.rpartition("@")[2]
            raise ValueError(f"the URL of a dataset {error}: it is {address!r}") from error
        url = url.rstrip("/")
        version = re.match(r"(.*/versions/\d+)(/files|/manifest)?$", url)
        super().__init__(f"{version[1]}/files" if version else url)
        # A key that the caller passes is for this URL. That of the environment may not be.
        self._api_key = api_key or api_key_for(self._url)

    def fetch(
        self, path: str, part: range | None = None, *, limit: int = DOCUMENT_BYTES
    ) -> Fetched:
        """Return the bytes of a file, or of a part of it; see `Source`."""
        url = f"{self}/{path}"
        if part is None:
            response = self._get(url, {}, limit)
            self._check_status(url, response.status_code, expected=200)
            return Fetched(response.content, len(response.content))

        # The answer says in its header which part it is, and how large the file is.
        bounds = f"{part.start}-{part.stop - 1}"
        response = self._get(url, {"Range": f"bytes={bounds}"}, len(part))
        if response.status_code == 416:
            raise CorruptDataError(f"{url} ends before bytes {bounds}")
        self._check_status(url, response.status_code, expected=206)
        header = response.headers.get("Content-Range", "")
        content_range = re.fullmatch(r"bytes (\d+-\d+)/(\d+)", header)
        if content_range is None or content_range[1] != bounds:
            raise CorruptDataError(
                f"{url} sent the range {header[:100]!r}, and bytes {bounds} were expected"
            )
        return Fetched(response.content, int(content_range[2]))

    def close(self) -> None:
        """Close the connections of this process."""
        # The connections of the parent process are the parent's to close.
        if self._client is not None and self._pid == os.getpid():
            self._client.close()
        self._client = None

    def _check_status(self, url: str, status: int, *, expected: int) -> None:
        """Raise an error unless the server answered with the status of success."""
        if status == expected:
            return
        if status == 404:
            raise MissingFileError(f"{url} is not there")
        hint = through(url)
        if status == 200:
            hint += ": it does not serve ranges"
        if status == 401:
            hint += self._hint_of_key()
        raise SourceError(f"{url} answered {status}, and {expected} was expected{hint}")

    def _hint_of_key(self) -> str:
        """Return words on the key of the environment, if it was not sent."""
        if self._api_key is not None or api_key_of_environment() is None:
            return ""
        return (
            f". The key of {API_KEY_VARIABLE} was not sent, because it belongs to the coordinator "
            f"{coordinator_url()}: name another with {URL_VARIABLE}, or pass api_key"
        )

    def _get(self, url: str, headers: dict[str, str], limit: int) -> Any:
        """Return the answer to a GET, which is repeated while the server is busy or restarts."""
        # Only who reads over HTTP waits for the import of httpx.
        from stickslip_schemas.transport.http import AnswerError, HttpClient, TransportError

        if self._client is None or self._pid != os.getpid():
            # A fork shares the parent's sockets: the child must not use them, nor close them.
            self._client = HttpClient(
                api_key=self._api_key, retry_timeout=READER_RETRY_SECONDS, follow_redirects=True
            )
            self._pid = os.getpid()
        try:
            return self._client.request("GET", url, limit=limit, headers=headers)
        except TransportError as error:
            raise SourceError(f"{url}: {error}") from error
        except AnswerError as error:
            # A server without ranges sends all of the file, which is too much.
            self._check_status(url, error.status, expected=206 if headers else 200)
            raise CorruptDataError(str(error)) from error
