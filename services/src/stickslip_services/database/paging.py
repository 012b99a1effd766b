"""Pages of lists. A token names the last item, so that a page does not change while the list grows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from stickslip_schemas.documents.responses import Page

MAX_PAGE_SIZE = 1000

TOKEN_PATTERN = r"^[0-9]{1,18}$"
"""Pattern of page tokens; every number is a valid position in a list."""

S = TypeVar("S")
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class PageRequest:
    """The requested page: at most `size` items beyond the position `after`."""

    size: int
    after: int | None

    @classmethod
    def from_query(cls, page_size: int, page_token: str | None) -> "PageRequest":
        """Read a page token of the form TOKEN_PATTERN."""
        return cls(page_size, None if page_token is None else int(page_token))


def make_page(
    rows: Sequence[S], request: PageRequest, *, position: Callable[[S], int], item: Callable[[S], T]
) -> Page[T]:
    """Return the page of `rows`; one row more than a page tells that there is a next page."""
    shown = rows[: request.size]
    more = len(rows) > request.size
    token = str(position(shown[-1])) if more else None
    return Page[T](items=tuple(item(row) for row in shown), next_page_token=token)
