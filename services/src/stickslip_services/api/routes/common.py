"""Shared by routes: the context, pages of lists, strictly parsed request bodies, files, and their
OpenAPI attributes.

Artifacts are immutable files with conditional and range requests [RFC 9110, 13 and 14; RFC 9530].
"""

import base64
import json
import re
from collections import Counter
from contextlib import suppress
from math import isfinite
from pathlib import PurePosixPath
from typing import Annotated, Any, Generic, TypeVar

from fastapi import Depends, Path, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import TypeAdapter, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect
from stickslip_schemas.base import Sha256
from stickslip_schemas.documents.problems import MEDIA_TYPE, ProblemCode, field_errors
from stickslip_schemas.store import Store

from stickslip_services.api.problems import ProblemError
from stickslip_services.database.database import MAX_PAGE_SIZE, TOKEN_PATTERN, PageRequest
from stickslip_services.queue.context import Context


def _context(request: Request) -> Context:
    context: Context = request.app.state.context
    return context


ContextDep = Annotated[Context, Depends(_context)]


def _page(
    page_size: Annotated[
        int, Query(ge=1, le=MAX_PAGE_SIZE, description="the most items to return")
    ] = 50,
    page_token: Annotated[
        str | None, Query(pattern=TOKEN_PATTERN, description="`next_page_token` of the page before")
    ] = None,
) -> PageRequest:
    return PageRequest(page_size, None if page_token is None else int(page_token))


PageDep = Annotated[PageRequest, Depends(_page)]
Version = Annotated[int, Path(ge=1, lt=2**31)]

_TITLES = {
    400: "The body is not JSON",
    401: "The key is missing or not known",
    403: "The key lacks the scope, or the request names a foreign host or comes from a page of another site",
    404: "Not found",
    409: "The state does not allow it; `detail` names the state",
    413: "The body is too large",
    415: "The `Content-Type` of the body is not JSON",
    416: "The range lies outside the file",
    422: "The request breaks a rule; `errors` lists the fields, rules and values",
    429: "The project of the key has as much in flight as it may have, or the key or the address as many streams",
    500: "The coordinator failed; its log says more",
    503: "The coordinator is busy or cannot reach its database; try again later",
}

BODY_PROBLEMS = (400, 413, 415, 422)

Responses = dict[int | str, dict[str, Any]]


def problem_responses(*statuses: int) -> Responses:
    """Return the OpenAPI responses of the problems that a route may answer with."""
    schema = {"$ref": "#/components/schemas/Problem"}
    return {
        status: {"description": _TITLES[status], "content": {MEDIA_TYPE: {"schema": schema}}}
        for status in sorted({*statuses, 401, 403, 500, 503})
    }


def json_content(name: str) -> dict[str, Any]:
    """Return the OpenAPI content of the JSON document `name`."""
    return {"application/json": {"schema": {"$ref": f"#/components/schemas/{name}"}}}


def reads(name: str, *problems: int, answers: Responses | None = None) -> dict[str, Any]:
    """Return the OpenAPI attributes of a route that reads the document `name`."""
    body = {"requestBody": {"required": True, "content": json_content(name)}}
    return {
        "responses": (answers or {}) | problem_responses(*problems, *BODY_PROBLEMS),
        "openapi_extra": body,
    }


_FILE_HEADERS = {
    name: {"description": description, "schema": {"type": "string"}}
    for name, description in {
        "ETag": "The SHA-256 of the whole file, quoted",
        "Repr-Digest": "The SHA-256 of the whole file [RFC 9530]",
        "Accept-Ranges": "bytes",
        "Cache-Control": "The file never changes",
    }.items()
}


def serves(content: dict[str, Any], *problems: int) -> dict[str, Any]:
    """Return the OpenAPI attributes of a route that serves an artifact."""
    responses: Responses = {
        200: {"description": "The file", "headers": _FILE_HEADERS, "content": content},
        206: {
            "description": "The range that was asked for",
            "headers": _FILE_HEADERS,
            "content": content,
        },
        304: {"description": "The client has it already", "headers": _FILE_HEADERS},
    }
    return {
        "response_class": Response,
        "responses": responses | problem_responses(404, 416, *problems),
    }


T = TypeVar("T")

SHOWN_ERRORS = 20


class JsonBody(Generic[T]):
    """A dependency that reads a request's body as a document."""

    def __init__(self, of: Any, *, from_workers: bool = False) -> None:
        """Read documents of a type: a model or a union of models.

        Those of workers are mostly written by pydantic.
        """
        self._of = of
        self._from_workers = from_workers
        self._adapter: TypeAdapter[T] = TypeAdapter(of)

    async def __call__(self, request: Request) -> T:
        body = await self.received(request)
        # A body of many megabytes keeps a thread busy, and not the event loop.
        document: T = await run_in_threadpool(self.read, body)
        return document

    async def received(self, request: Request) -> bytes:
        """Return the raw body; raise ProblemError where its Content-Type is not JSON."""
        media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
        if media_type != "application/json" and not media_type.endswith("+json"):
            detail = f"Content-Type must be application/json, and it is {media_type[:100]!r}"
            raise ProblemError(415, ProblemCode.malformed_body, detail)
        return await whole_body(request)

    def read(self, body: bytes) -> T:
        """Return the document in a body, JSON [RFC 8259] in UTF-8 without duplicate keys; raise
        ProblemError.
        """
        if self._from_workers:
            with suppress(ValidationError):
                document = self._adapter.validate_json(body)
                if self._adapter.dump_json(document) == body:  # so no key is there twice
                    return document
        strange: list[str] = []

        def number(text: str) -> float:
            value = float(text)
            if not isfinite(value):
                strange.append(text)
            return value

        try:
            text = body.decode("utf-8")
            values = json.loads(
                text, object_pairs_hook=_no_key_twice, parse_float=number, parse_constant=number
            )
            if "\\u" in text:
                json.dumps(values, ensure_ascii=False).encode(
                    "utf-8"
                )  # lone surrogates have no UTF-8 form
            valid = self._adapter.validate_python(values)
            if strange:  # models refuse NaN with its place; this covers free-form parts
                raise ValueError(f"{strange[0]} is no number")
            return valid
        except ValidationError as error:
            fields = field_errors(error, values, self._of, at_most=SHOWN_ERRORS)
            count = error.error_count()
        except RecursionError as error:
            raise ProblemError(
                400, ProblemCode.malformed_body, "the document is nested too deeply"
            ) from error
        except (
            ValueError
        ) as error:  # also bytes that are not UTF-8, and integers of more than 4300 digits
            raise ProblemError(
                400, ProblemCode.malformed_body, f"the body is not JSON: {error}"[:500]
            ) from error
        detail = "; ".join(
            f"{field.pointer or 'the document'}: {field.rule}" for field in fields[:3]
        )
        more = f" (and {count - 3} more)" if count > 3 else ""
        raise ProblemError(422, ProblemCode.validation_failed, detail + more, fields=fields)


async def whole_body(request: Request) -> bytes:
    """Return the raw body; raise ProblemError where it is too large, or ends too soon."""
    limit, body = request.app.state.context.settings.body_limit, bytearray()
    detail = f"a body may have at most {limit} bytes"
    too_large = ProblemError(
        413, ProblemCode.body_too_large, detail, headers={"Connection": "close"}
    )
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and (len(declared) > 15 or int(declared) > limit):
        raise too_large
    try:
        async for block in request.stream():
            body += block
            if len(body) > limit:
                raise too_large
    except ClientDisconnect as error:
        raise ProblemError(400, ProblemCode.malformed_body, "the body ends too soon") from error
    return bytes(body)


def _no_key_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) != len(pairs):
        twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"the key {twice[:100]!r} is there twice")
    return document


_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")
_MEDIA_TYPES = {
    ".json": "application/json",
    ".png": "image/png",
    ".webp": "image/webp",
    ".html": "text/html",
}


def picture_format(store: Store, digest: Sha256) -> str:
    """Return the format of a picture, png or webp, from its first bytes.

    Png for an unreadable file.
    """
    try:
        head = store.read(digest, length=12)
    except OSError:
        return "png"
    return "webp" if head[:4] == b"RIFF" and head[8:] == b"WEBP" else "png"


def serve(
    request: Request, store: Store, digest: Sha256, *, name: str, size: int | None = None
) -> Response:
    """Answer with an artifact, or with the requested range of it; `size` in bytes saves a look-up."""
    etag = f'"{digest}"'
    headers = {
        "ETag": etag,
        "Repr-Digest": f"sha-256=:{base64.b64encode(bytes.fromhex(digest)).decode()}:",
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, max-age=31536000, immutable",
    }
    if matches(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    size = store.size(digest) if size is None else size
    media_type = _MEDIA_TYPES.get(PurePosixPath(name).suffix, "application/octet-stream")
    wanted = request.headers.get("range")
    if wanted is not None and request.headers.get("if-range", etag).strip() != etag:
        wanted = None  # the client has a part of another file
    span = None if wanted is None or request.method == "HEAD" else _span(wanted, size, headers)
    first, last = (0, size - 1) if span is None else span
    headers["Content-Length"] = str(last - first + 1)
    if span is not None:
        headers["Content-Range"] = f"bytes {first}-{last}/{size}"
    status = 200 if span is None else 206
    if request.method == "HEAD":
        return Response(status_code=status, headers=headers, media_type=media_type)
    return StreamingResponse(store.stream(digest, first, last + 1), status, headers, media_type)


def matches(header: str | None, etag: str) -> bool:
    """Return whether an entity tag is among those of `If-None-Match` [RFC 9110, 13.1.2]."""
    if header is None:
        return False
    return header.strip() == "*" or etag in (
        item.strip().removeprefix("W/") for item in header.split(",")
    )


def _span(header: str, size: int, headers: dict[str, str]) -> tuple[int, int] | None:
    """Return the first and last byte of the range, or None for the whole file.

    Other forms, and multiple ranges, are ignored, as the RFC permits.
    """
    match = _RANGE.fullmatch(header.strip())
    if match is None or match.group() == "bytes=-":
        return None
    start, end = match.groups()
    if start and end and int(end) < int(start):
        return None
    first = int(start) if start else max(0, size - int(end))
    last = min(int(end), size - 1) if start and end else size - 1
    if first > last or (not start and int(end) == 0):
        raise ProblemError(
            416,
            ProblemCode.validation_failed,
            f"the range {header[:100]!r} lies outside the file, which has {size} bytes",
            headers=headers | {"Content-Range": f"bytes */{size}", "Cache-Control": "no-store"},
        )
    return first, last
