"""Pages of lists. A token names the last item seen, so that a page stays what it is while the list grows."""

import base64
import binascii
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from stickslip_schemas.responses import Page

MAX_PAGE_SIZE = 1000

_NOT_OURS = "page_token must come from an earlier page"

S = TypeVar("S")
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class PageRequest:
    """Which page is asked for: at most `size` items beyond the position `after`."""

    size: int
    after: int | None

    @classmethod
    def from_query(cls, page_size: int, page_token: str | None) -> "PageRequest":
        """Read a page token; raise ValueError where it is none of ours."""
        return cls(page_size, None if page_token is None else _position(page_token))


def make_page(
    rows: Sequence[S], request: PageRequest, *, position: Callable[[S], int], item: Callable[[S], T]
) -> Page[T]:
    """Return the page of `rows`, of which one more than a page was read to see whether there are more."""
    shown = rows[: request.size]
    more = len(rows) > request.size
    token = _token(position(shown[-1])) if more else None
    return Page[T](items=tuple(item(row) for row in shown), next_page_token=token)


def _token(position: int) -> str:
    return base64.urlsafe_b64encode(str(position).encode()).decode().rstrip("=")


def _position(token: str) -> int:
    try:
        text = base64.b64decode(token + "=" * (-len(token) % 4), altchars=b"-_", validate=True).decode("ascii")
    except (binascii.Error, ValueError) as error:
        raise ValueError(_NOT_OURS) from error
    if not text.isdecimal() or len(text) > 18:
        raise ValueError(_NOT_OURS)
    return int(text)
