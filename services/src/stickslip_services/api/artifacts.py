"""Artifacts over HTTP: immutable files with conditional and range requests.

RFC 9110, 13 and 14, and RFC 9530.
"""

import base64
import re
from pathlib import PurePosixPath

from fastapi import Request, Response
from fastapi.responses import StreamingResponse
from stickslip_schemas.base import Sha256
from stickslip_schemas.documents.problems import ProblemCode
from stickslip_schemas.store import Store

from stickslip_services.api.problems import ProblemError

CACHE_CONTROL = "private, max-age=31536000, immutable"
"""An artifact never changes, so a browser may keep it for a year. A proxy may not: another project
has no right to it."""

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
    is_webp = head[:4] == b"RIFF" and head[8:] == b"WEBP"
    return "webp" if is_webp else "png"


def serve(
    request: Request, store: Store, digest: Sha256, *, name: str, size: int | None = None
) -> Response:
    """Answer with an artifact, or with the requested range of it.

    `name` gives the media type. `size` [bytes] saves a look-up in the store.
    """
    etag = f'"{digest}"'
    digest_value = base64.b64encode(bytes.fromhex(digest)).decode()
    headers = {
        "ETag": etag,
        "Repr-Digest": f"sha-256=:{digest_value}:",
        "Accept-Ranges": "bytes",
        "Cache-Control": CACHE_CONTROL,
    }
    # The digest is the tag, so a client that has it has the file.
    if matches(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    if size is None:
        size = store.size(digest)
    media_type = _MEDIA_TYPES.get(PurePosixPath(name).suffix, "application/octet-stream")

    # A range holds only for the file of which the client has the other part.
    range_header = request.headers.get("range")
    is_same_file = request.headers.get("if-range", etag).strip() == etag
    span = None
    if range_header is not None and is_same_file and request.method != "HEAD":
        span = _span(range_header, size, headers)

    first, last = (0, size - 1) if span is None else span
    # With a length, a client notices a body that was cut off.
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
    if header.strip() == "*":
        return True
    return etag in (item.strip().removeprefix("W/") for item in header.split(","))


def _span(header: str, size: int, headers: dict[str, str]) -> tuple[int, int] | None:
    """Return the first and last byte of a range, or None for the whole file.

    Other forms, and multiple ranges, are ignored, as the RFC permits. Raise ProblemError if the
    range lies outside the file.
    """
    match = _RANGE.fullmatch(header.strip())
    if match is None or match.group() == "bytes=-":
        return None
    start, end = match.groups()
    if start and end and int(end) < int(start):
        return None
    if start:
        first = int(start)
        last = min(int(end), size - 1) if end else size - 1
    else:
        # bytes=-N: the last N bytes.
        first = max(0, size - int(end))
        last = size - 1
    is_empty = not start and int(end) == 0
    if first > last or is_empty:
        raise ProblemError(
            416,
            ProblemCode.validation_failed,
            f"the range {header[:100]!r} lies outside the file, which has {size} bytes",
            headers=headers | {"Content-Range": f"bytes */{size}", "Cache-Control": "no-store"},
        )
    return first, last
