"""Rows as documents, and pages of lists, whose tokens name the last item: a page stays while the list grows."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from pydantic import BaseModel
from sqlalchemy import Column, Connection, Row, Select
from stickslip_schemas.documents.responses import Page

MAX_PAGE_SIZE = 1000

TOKEN_PATTERN = r"^[0-9]{1,18}$"
"""Pattern of page tokens; every number is a valid position in a list."""

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class PageRequest:
    """The requested page: at most `size` items beyond the position `after`."""

    size: int
    after: int | None


def document_of(model: type[M], row: Any, **more: Any) -> M:
    """Return a document with the values of a row, or of an object, for its fields, and with `more`.

    Times, in seconds since 1970, become dates in UTC.
    """
    found = {name: getattr(row, name) for name in model.model_fields if name not in more and hasattr(row, name)}
    return model.model_validate(found | more)


def read_page(
    connection: Connection,
    query: Select[Any],
    page: PageRequest,
    position: Column[Any],
    items: Callable[[Sequence[Row[Any]]], Iterable[T]],
    *,
    newest_first: bool = True,
) -> Page[T]:
    """Return a page of the rows of `query`, ordered by the column `position`; `items` converts rows."""
    query = query.order_by(position.desc() if newest_first else position).limit(page.size + 1)
    if page.after is not None:
        query = query.where(position < page.after if newest_first else position > page.after)
    rows = connection.execute(query).all()
    shown = rows[: page.size]
    token = str(getattr(shown[-1], position.key)) if len(rows) > page.size else None  # one row more than a page
    return Page[T](items=tuple(items(shown)), next_page_token=token)
