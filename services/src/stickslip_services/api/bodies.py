"""Bodies of requests: limits that are checked before anything is decoded, and strict JSON.

A body is limited in bytes while it arrives, and in lists and objects before it is parsed. Both
keep the time and memory of a hostile document small: a model takes microseconds and a kilobyte for
each wrong item, of which a megabyte of `[],[],[]` has 300,000.
"""

import json
import threading
from collections import Counter
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from math import isfinite
from tempfile import TemporaryFile
from typing import IO, Any, Generic, TypeVar

from fastapi import Request
from pydantic import TypeAdapter, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect
from stickslip_schemas.documents.problems import FieldError, ProblemCode, field_errors
from typing_extensions import TypeForm

from stickslip_services.api.problems import ProblemError

T = TypeVar("T")

SPEC_BYTES = 2**20
"""Largest spec [bytes]. A list of 50,000 values has about 0.9 MB; larger grids have ranges."""

CERTIFICATE_BYTES = 4 * 2**20
"""Largest certificate [bytes]. A full one of all protocols has about 0.4 MB."""

SMALL_BYTES = 256 * 2**10
"""Largest body of a request that changes or registers one thing [bytes]."""

MAX_CONTAINERS = 20_000
"""Lists and objects in a document: of a scene with 10 motions of 1,000 keys each."""

LARGE_BYTES = 2**20
"""Larger documents are read one at a time [bytes]: a report of a worker of 16 MiB takes 0.3 GB and
1 s. The parser of Python calls functions for numbers, so other requests get their turn."""

MAX_DIGITS = 4000
"""Digits of an integer: Python converts no more than 4,300, and its message is for programmers."""

SHOWN_ERRORS = 20
"""Wrong fields that an answer lists."""

SUMMARISED_ERRORS = 3
"""Wrong fields in the sentence of an answer."""


_LARGE_BODY = threading.Lock()


class JsonBody(Generic[T]):
    """A dependency that reads the body of a request as a document."""

    def __init__(
        self,
        document_type: TypeForm[T],
        *,
        max_bytes: int | None = None,
        max_containers: int = MAX_CONTAINERS,
        from_workers: bool = False,
    ) -> None:
        """Read documents of a type: a model, or a union of models.

        `max_bytes` is the largest body; None: the setting `body_limit`. Documents of workers are
        mostly written by pydantic.
        """
        self._type = document_type
        self._max_bytes = max_bytes
        self._max_containers = max_containers
        self._from_workers = from_workers
        self._adapter: TypeAdapter[T] = TypeAdapter(document_type)

    async def __call__(self, request: Request) -> T:
        """Return the document in the body of a request; raise ProblemError."""
        body = await self.receive(request)
        # A body of many kilobytes keeps a thread busy, and not the event loop.
        document: T = await run_in_threadpool(self.read, body)
        return document

    async def receive(self, request: Request) -> bytes:
        """Return the raw body; raise ProblemError if its Content-Type is not JSON."""
        media_type = content_type(request)
        if media_type != "application/json" and not media_type.endswith("+json"):
            raise wrong_media_type("application/json", media_type)
        return await whole_body(request, self._max_bytes)

    def read(self, body: bytes) -> T:
        """Return the document in a body; raise ProblemError.

        The body must be JSON [RFC 8259] in UTF-8, without duplicate keys and without NaN.
        """
        self._check_containers(body)
        if len(body) <= LARGE_BYTES:
            return self._read(body, is_large=False)
        with _LARGE_BODY:
            return self._read(body, is_large=True)

    def _read(self, body: bytes, *, is_large: bool) -> T:
        # pydantic keeps the interpreter until it has read a whole body: 1 to 2 s for 16 MB.
        if self._from_workers and not is_large:
            # Most messages of workers are in the very form that pydantic writes, and pydantic
            # reads them five times faster. If it writes the same bytes again, no key is duplicate.
            with suppress(ValidationError):
                document = self._adapter.validate_json(body)
                if self._adapter.dump_json(document) == body:
                    return document
        values, not_finite = _parse(body)
        try:
            document = self._adapter.validate_python(values)
        except ValidationError as error:
            raise self._refusal(error, values) from error
        except RecursionError as error:
            raise _too_deep() from error
        # Models refuse NaN and name its field; this covers parts of free form.
        if not_finite:
            raise malformed(f"{not_finite[0]} is no number")
        return document

    def _check_containers(self, body: bytes) -> None:
        """Raise ProblemError if a document has too many lists and objects.

        Brackets in strings count too: they are few, and finding them costs a parser.
        """
        count = body.count(b"[") + body.count(b"{")
        if count <= self._max_containers:
            return
        rule = f"must have at most {self._max_containers} lists and objects, and has {count}"
        field = FieldError(pointer="", rule=rule, value="")
        detail = f"the document {rule}"
        raise ProblemError(422, ProblemCode.validation_failed, detail, fields=[field])

    def _refusal(self, error: ValidationError, values: object) -> ProblemError:
        """Return the problem that lists the first wrong fields of a document."""
        # A field error takes time, to find the name that was meant: the first ones suffice.
        fields = field_errors(error, values, self._type, at_most=SHOWN_ERRORS)
        sentences = [
            f"{field.pointer or 'the document'}: {field.rule}"
            for field in fields[:SUMMARISED_ERRORS]
        ]
        detail = "; ".join(sentences)
        further_errors = error.error_count() - SUMMARISED_ERRORS
        if further_errors > 0:
            detail += f" (and {further_errors} more)"
        return ProblemError(422, ProblemCode.validation_failed, detail, fields=fields)


def malformed(reason: str) -> ProblemError:
    """Return the refusal of a body that is not JSON."""
    detail = f"the body is not JSON: {reason}"[:500]
    return ProblemError(400, ProblemCode.malformed_body, detail)


def _too_deep() -> ProblemError:
    return ProblemError(400, ProblemCode.malformed_body, "the document is nested too deeply")


def _parse(body: bytes) -> tuple[Any, list[str]]:
    """Return the values of a JSON document, and the numbers that are not finite.

    Raise ProblemError if it is not JSON, or names a key twice.
    """
    not_finite: list[str] = []

    def to_int(text: str) -> int:
        if len(text) > MAX_DIGITS:
            raise ValueError(
                f"an integer must have at most {MAX_DIGITS} digits, and one has {len(text)}"
            )
        return int(text)

    def to_float(text: str) -> float:
        number = float(text)
        if not isfinite(number):
            not_finite.append(text)
        return number

    try:
        text = body.decode("utf-8")
        values = json.loads(
            text,
            object_pairs_hook=_object_without_duplicates,
            parse_int=to_int,
            parse_float=to_float,
            parse_constant=to_float,
        )
        if "\\u" in text:
            # Escapes can spell lone surrogates, which have no UTF-8 form and fit in no column.
            json.dumps(values, ensure_ascii=False).encode("utf-8")
    except RecursionError as error:
        raise _too_deep() from error
    except ValueError as error:
        raise malformed(_syntax_fault(error)) from error
    return values, not_finite


def _syntax_fault(error: ValueError) -> str:
    """Return what is wrong with the text of a body, without words for programmers."""
    match error:
        case UnicodeDecodeError():
            return f"it must be text in UTF-8, and byte {error.start} is not"
        case UnicodeEncodeError():
            return f"it must not have the lone surrogate {error.object[error.start]!a}"
        case json.JSONDecodeError():
            return f"{error.msg}, line {error.lineno}, column {error.colno}"
        case _:
            return str(error)


def _object_without_duplicates(pairs: list[tuple[str, Any]]) -> Mapping[str, Any]:
    values = dict(pairs)
    if len(values) != len(pairs):
        counts = Counter(key for key, _ in pairs)
        key, count = counts.most_common(1)[0]
        raise ValueError(f"the key {key[:100]!r} is there {'twice' if count == 2 else count}")
    return values


def content_type(request: Request) -> str:
    """Return the media type of a body without its parameters, in lower case."""
    media_type: str = request.headers.get("content-type", "").partition(";")[0]
    return media_type.strip().lower()


def wrong_media_type(expected: str, media_type: str) -> ProblemError:
    """Return the refusal of a body by its Content-Type."""
    actual = f"it is {media_type[:100]!r}" if media_type else "there is none"
    detail = f"Content-Type must be {expected}, and {actual}"
    return ProblemError(415, ProblemCode.malformed_body, detail)


async def whole_body(request: Request, max_bytes: int | None = None) -> bytes:
    """Return the raw body; raise ProblemError if it is too large, or ends too soon."""
    body = bytearray()
    async for block in _blocks(request, max_bytes):
        body += block
    return bytes(body)


@asynccontextmanager
async def spooled_body(request: Request) -> AsyncIterator[IO[bytes]]:
    """Write the raw body to a file without a name; raise ProblemError as `whole_body` does.

    Many uploads at once, which wait for their turn to be decoded, thus take no memory. The file is
    in the data directory, since a temporary directory may itself be in memory.
    """
    with TemporaryFile(dir=request.app.state.context.settings.data) as file:
        async for block in _blocks(request, None):
            file.write(block)
        file.seek(0)
        yield file


async def _blocks(request: Request, max_bytes: int | None) -> AsyncIterator[bytes]:
    """Yield the body as it arrives.

    No route accepts more than the setting `body_limit`. The Content-Length is checked before
    anything is read, and the bytes themselves, since it may be missing or wrong.
    """
    limit: int = request.app.state.context.settings.body_limit
    if max_bytes is not None:
        limit = min(limit, max_bytes)
    # The client may still be sending: it must not send another request on this connection.
    headers = {"Connection": "close"}
    detail = f"the body of this request may have at most {limit} bytes"
    too_large = ProblemError(413, ProblemCode.body_too_large, detail, headers=headers)
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and (len(declared) > 15 or int(declared) > limit):
        raise too_large
    received = 0
    try:
        async for block in request.stream():
            received += len(block)
            if received > limit:
                raise too_large
            yield block
    except ClientDisconnect as error:
        raise ProblemError(400, ProblemCode.malformed_body, "the body ends too soon") from error
