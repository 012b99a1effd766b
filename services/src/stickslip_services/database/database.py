"""The database: transactions over SQLite, written so that PostgreSQL can take its place.

There is one way to read and one to write. A write holds the database's write lock from its first statement
(`BEGIN IMMEDIATE`): it never finds at its end that somebody else was faster, so nothing has to be tried again.
"""

import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy import URL, Connection, Table, create_engine, event

T = TypeVar("T")

BATCH = 5000
"""How many values go into one IN (...) and how many rows into one executemany."""

_PRAGMAS = (
    "journal_mode=WAL",  # readers and the writer do not wait for each other
    "busy_timeout=30000",  # another process may look at the database (a backup, a person)
    "foreign_keys=ON",
    "cache_size=-65536",  # 64 MiB: the index of 200,000 task keys fits
    "journal_size_limit=67108864",  # the log of a big plan does not stay that big
)


class Database:
    """Transactions on one database file."""

    def __init__(self, path: Path, *, durable: bool = True) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        # FULL: what was answered with 202, or accepted as a dataset version, is there after a power cut, too. A
        # commit costs an fsync; leases and reports come in batches, so that is a handful a second.
        self._pragmas = (*_PRAGMAS, "synchronous=FULL" if durable else "synchronous=OFF")
        url = URL.create("sqlite+pysqlite", database=str(path))
        self._engine = create_engine(url, connect_args={"timeout": 30}, pool_size=8, max_overflow=40)
        # SQLite's own waiting for the write lock polls and is unfair; threads of this process queue up here.
        self._writing = threading.Lock()
        event.listen(self._engine, "connect", self._prepare)
        event.listen(self._engine, "begin", _begin)

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """Open a transaction that sees one state of the database."""
        with self._engine.connect() as connection, connection.begin():
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """Open a transaction that is alone in writing; it is durable when the block has been left."""
        with self._writing, self._engine.connect() as connection:
            connection.execution_options(stickslip_write=True)
            with connection.begin():
                yield connection

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()

    def _prepare(self, connection: Any, _record: Any) -> None:
        connection.isolation_level = None  # transactions are begun by _begin, not by the driver
        for pragma in self._pragmas:
            connection.execute(f"PRAGMA {pragma}")


def _begin(connection: Connection) -> None:
    immediate = connection.get_execution_options().get("stickslip_write", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")


def batches(items: Iterable[T], size: int = BATCH) -> Iterator[list[T]]:
    """Yield `items` in lists of at most `size`."""
    iterator = iter(items)
    while batch := list(islice(iterator, size)):
        yield batch


def insert_rows(connection: Connection, table: Table, columns: Sequence[str], rows: Iterable[tuple[Any, ...]]) -> None:
    """Insert many rows by the driver's own executemany: an SQL expression per row would cost five times as much."""
    marks = {"qmark": "?", "format": "%s", "pyformat": "%s"}[connection.dialect.paramstyle]
    statement = f"INSERT INTO {table.name} ({', '.join(columns)}) VALUES ({', '.join([marks] * len(columns))})"
    for batch in batches(rows, 20 * BATCH):
        connection.exec_driver_sql(statement, batch)
