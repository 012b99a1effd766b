"""Serving artifacts: immutable files with conditional and range requests [RFC 9110, 13 and 14; RFC 9530]."""

import base64
import re
from pathlib import PurePosixPath

from fastapi import Request, Response
from fastapi.responses import StreamingResponse
from stickslip_schemas.base import Sha256
from stickslip_schemas.documents.problems import ProblemCode
from stickslip_schemas.store import Store

from stickslip_services.api.problems import ProblemError

_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")
_MEDIA_TYPES = {".json": "application/json", ".png": "image/png", ".webp": "image/webp", ".html": "text/html"}

OPENAPI_HEADERS = {
    name: {"description": description, "schema": {"type": "string"}}
    for name, description in {
        "ETag": "The SHA-256 of the whole file, quoted",
        "Repr-Digest": "The SHA-256 of the whole file [RFC 9530]",
        "Accept-Ranges": "bytes",
        "Cache-Control": "The file never changes",
    }.items()
}


def picture_format(store: Store, digest: Sha256) -> str:
    """Return the format of a picture, png or webp, from its first bytes; png for an unreadable file."""
    try:
        head = store.read(digest, length=12)
    except OSError:
        return "png"
    return "webp" if head[:4] == b"RIFF" and head[8:] == b"WEBP" else "png"


def serve(request: Request, store: Store, digest: Sha256, *, name: str, size: int | None = None) -> Response:
    """Answer with an artifact, or with the requested range of it; `size` in bytes saves a look-up."""
    etag = f'"{digest}"'
    headers = {
        "ETag": etag,
        "Repr-Digest": f"sha-256=:{base64.b64encode(bytes.fromhex(digest)).decode()}:",
        "Accept-Ranges": "bytes",
        "Cache-Control": "public, max-age=31536000, immutable",
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
    return header.strip() == "*" or etag in (item.strip().removeprefix("W/") for item in header.split(","))


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
