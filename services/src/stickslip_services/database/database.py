"""Transactions on the database: SQLite in the data directory, or PostgreSQL at a URL.

A write transaction excludes other writers from its first statement on, so it never conflicts at its end, and needs no
retries.
"""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from enum import Enum, auto
from itertools import islice
from typing import Any, TypeVar

from sqlalchemy import Column, Connection, Engine, Select, Table, event

T = TypeVar("T")

BATCH = 5000
"""Number of values in one IN (...), and a twentieth of the rows of one executemany."""


class Role(Enum):
    """The purpose of a connection. Any number of coordinators may share a database; upkeep needs it exclusively."""

    coordinator = auto()
    upkeep = auto()
    visitor = auto()
    """A command that reads and writes a few rows beside the others."""


class Database(ABC):
    """Transactions on one database."""

    def __init__(self, reader: Engine, writer: Engine, *others: Engine) -> None:
        self._reader = reader
        self._writer = writer
        self._engines = {reader, writer, *others}
        # The database's own waiting is unfair, or takes a connection, so threads of this process wait here.
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

    @abstractmethod
    def write(self) -> AbstractContextManager[Connection]:
        """Open a transaction that excludes other writers; it is durable after the block."""

    def touch(self) -> AbstractContextManager[Connection]:
        """Connect for changes that may be lost, beside writers where the database has row locks.

        There each statement is a transaction, which must not wait for a row while it holds another:
        `with_for_update(skip_locked=True)`.
        """
        return self.write()

    def analyse(self) -> None:
        """Tell the database how large its tables have become, where it must know that to choose plans."""
        return

    def is_alone(self, connection: Connection) -> bool:
        """Return whether no other coordinator uses the database; call it in a write transaction."""
        return True

    async def listen(self, notify: Callable[[], None]) -> None:
        """Call `notify` whenever another coordinator has written, until cancelled."""
        return

    def close(self) -> None:
        """Close all connections; one that a thread still uses is closed when it is returned."""
        for engine in self._engines:
            event.listen(engine, "checkin", lambda _, record: record.close())
            engine.dispose()


def batches(items: Iterable[T], size: int = BATCH) -> Iterator[list[T]]:
    """Yield `items` in lists of at most `size`."""
    iterator = iter(items)
    while batch := list(islice(iterator, size)):
        yield batch


def rows_with(connection: Connection, query: Select[Any], column: Column[Any], values: Iterable[Any]) -> Iterator[Any]:
    """Yield the rows of `query` whose `column` has one of many values."""
    for batch in batches(values):
        yield from connection.execute(query.where(column.in_(batch)))


def insert_rows(connection: Connection, table: Table, columns: Sequence[str], rows: Iterable[tuple[Any, ...]]) -> None:
    """Insert many rows with the driver's executemany, at a fifth of the cost of SQL expressions."""
    mark = {"qmark": "?", "format": "%s"}[connection.dialect.paramstyle]
    statement = f"INSERT INTO {table.name} ({', '.join(columns)}) VALUES ({', '.join([mark] * len(columns))})"
    for batch in batches(rows, 20 * BATCH):
        connection.exec_driver_sql(statement, batch)
