"""Transactions on the database, documents and pages.

The database is SQLite in the data directory, or PostgreSQL at a URL.

A write transaction excludes other writers from its first statement on, so it never conflicts at its
end, and needs no retries.
"""

import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import Enum, auto
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel
from sqlalchemy import URL, Column, Connection, Engine, Row, Select, create_engine, event
from sqlalchemy.pool import ConnectionPoolEntry
from stickslip_schemas.documents.responses import Page

Clock = Callable[[], float]
"""Returns seconds since 1970 [s]."""

T = TypeVar("T")


class Role(Enum):
    """The purpose of a connection.

    Any number of coordinators may share a database; upkeep needs it exclusively.
    """

    coordinator = auto()
    upkeep = auto()
    visitor = auto()
    """A command that reads and writes a few rows beside the others."""


class Database:
    """Transactions on a database: any number of reads, and one write at a time."""

    def __init__(self, reader: Engine, writer: Engine, *further_engines: Engine) -> None:
        self._reader = reader
        self._writer = writer
        self._engines = {reader, writer, *further_engines}
        # The database's own waiting is unfair, or takes a connection, so threads of this process
        # wait here.
        self._writing = threading.Lock()
        self._ahead = time.time() - time.monotonic()

    def clock(self) -> float:
        """Return the current time that all coordinators on this database share [s since 1970].

        It is monotonic: setting the clock of this machine neither expires leases nor extends them.
        """
        return self._ahead + time.monotonic()

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """Open a read transaction on a snapshot of the database."""
        with self._reader.begin() as connection:
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """Open a transaction that excludes other writers; it is durable after the block."""
        with self._writing, self._writer.begin() as connection:
            yield connection

    def write_relaxed(self) -> AbstractContextManager[Connection]:
        """Connect for changes that may be lost, beside writers if the database has row locks.

        With row locks each statement is a transaction. It must not wait for a row while it holds
        another: `with_for_update(skip_locked=True)`.
        """
        return self.write()

    def analyse(self) -> None:
        """Tell the database how large its tables have become, if it needs that to choose plans."""
        return

    def is_alone(self, connection: Connection) -> bool:
        """Return whether no other coordinator uses the database; call it in a write transaction."""
        return True

    async def listen(self, notify: Callable[[], None]) -> None:
        """Call `notify` whenever another coordinator has written, until cancelled."""
        return

    def close(self) -> None:
        """Close all connections.

        A connection that a thread still uses is closed when the thread returns it.
        """
        for engine in self._engines:
            event.listen(engine, "checkin", lambda _, record: record.close())
            engine.dispose()


MAX_PAGE_SIZE = 1000

TOKEN_PATTERN = r"^[0-9]{1,18}$"
"""Pattern of page tokens; every number is a valid position in a list."""
M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class PageRequest:
    """The requested page: at most `size` items beyond the position `after`."""

    size: int
    after: int | None


def as_datetime(seconds: float) -> datetime:
    """Return a time in UTC [s since 1970]."""
    return datetime.fromtimestamp(seconds, UTC)


def document_of(model: type[M], row: object, **more: object) -> M:
    """Return a document with the values of a row, or of an object, for its fields, and with `more`.

    Times, in seconds since 1970, become dates in UTC.
    """
    fields = {
        name: getattr(row, name)
        for name in model.model_fields
        if name not in more and hasattr(row, name)
    }
    return model.model_validate(fields | more)


def read_page(
    connection: Connection,
    query: Select[Any],
    page: PageRequest,
    position: Column[Any],
    items: Callable[[Sequence[Row[Any]]], Iterable[T]],
    *,
    newest_first: bool = True,
) -> Page[T]:
    """Return a page of the rows of `query`, ordered by the column `position`.

    `items` converts rows.
    """
    query = query.order_by(position.desc() if newest_first else position).limit(page.size + 1)
    if page.after is not None:
        query = query.where(position < page.after if newest_first else position > page.after)
    rows = connection.execute(query).all()
    rows_of_page = rows[: page.size]
    token = (
        str(getattr(rows_of_page[-1], position.key)) if len(rows) > page.size else None
    )  # one row more than a page
    return Page[T](items=tuple(items(rows_of_page)), next_page_token=token)


_PRAGMAS = (
    "journal_mode=WAL",  # readers and the writer do not wait for each other
    "busy_timeout=30000",  # another process may look at the database (a backup, a person)
    "foreign_keys=ON",
    "journal_size_limit=67108864",  # the log of a big plan does not stay that big
)


class SqliteDatabase(Database):
    """Transactions on one file.

    A write takes SQLite's write lock with its first statement (`BEGIN IMMEDIATE`).
    """

    def __init__(self, path: Path, *, durable: bool = True) -> None:
        _close_to_others(path)
        # FULL: accepted jobs and dataset versions survive a power cut. A commit costs an fsync;
        # leases and reports come in batches, so there are only a few a second.
        pragmas = (*_PRAGMAS, "synchronous=FULL" if durable else "synchronous=OFF")
        url = URL.create("sqlite+pysqlite", database=str(path))
        # SQLite keeps the plans of so many statements for each connection (128 by default).
        arguments = {"timeout": 30, "cached_statements": 512}
        reader = create_engine(url, connect_args=arguments, pool_size=8, max_overflow=40)
        writer = create_engine(url, connect_args=arguments, pool_size=1, max_overflow=0)
        for engine, begin in ((reader, "BEGIN"), (writer, "BEGIN IMMEDIATE")):
            event.listen(engine, "connect", partial(_prepare, pragmas))
            event.listen(
                engine, "begin", lambda connection, begin=begin: connection.exec_driver_sql(begin)
            )
        super().__init__(reader, writer)


def _prepare(
    pragmas: Iterable[str], connection: sqlite3.Connection, _record: ConnectionPoolEntry
) -> None:
    connection.isolation_level = None  # the listeners begin transactions, not the driver
    connection.text_factory = partial(
        str, encoding="utf-8", errors="replace"
    )  # damaged text shows by its digest
    for pragma in pragmas:
        connection.execute(f"PRAGMA {pragma}")


def _close_to_others(path: Path) -> None:
    """Let nobody but the owner read the data directory and the database.

    SQLite gives its log the permissions of the database.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    for place, mode in ((path.parent, 0o700), (path, 0o600)):
        if place == path:
            place.touch(mode=mode)
        if place.stat().st_uid == os.geteuid():
            place.chmod(mode)
