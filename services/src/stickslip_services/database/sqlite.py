"""SQLite: a file in the data directory, for one coordinator."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, create_engine, event

from stickslip_services.database.database import Database

_PRAGMAS = (
    "journal_mode=WAL",  # readers and the writer do not wait for each other
    "busy_timeout=30000",  # another process may look at the database (a backup, a person)
    "foreign_keys=ON",
    "cache_size=-65536",  # 64 MiB: the index of 200,000 task keys fits
    "journal_size_limit=67108864",  # the log of a big plan does not stay that big
)


class SqliteDatabase(Database):
    """Transactions on one file. A write takes SQLite's write lock with its first statement (`BEGIN IMMEDIATE`)."""

    def __init__(self, path: Path, *, durable: bool = True) -> None:
        _close_to_others(path)
        # FULL: accepted jobs and dataset versions survive a power cut. A commit costs an fsync; leases and reports
        # come in batches, so there are only a few a second.
        self._pragmas = (*_PRAGMAS, "synchronous=FULL" if durable else "synchronous=OFF")
        url = URL.create("sqlite+pysqlite", database=str(path))
        engine = create_engine(url, connect_args={"timeout": 30}, pool_size=8, max_overflow=40)
        event.listen(engine, "connect", self._prepare)
        event.listen(engine, "begin", _begin)
        super().__init__(engine, engine)

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """Open a transaction that excludes other writers; it is durable after the block."""
        with self._writing, self._writer.connect() as connection:
            connection.execution_options(stickslip_write=True)
            with connection.begin():
                yield connection

    def _prepare(self, connection: Any, _record: Any) -> None:
        connection.isolation_level = None  # transactions are begun by _begin, not by the driver
        connection.text_factory = partial(str, encoding="utf-8", errors="replace")  # damaged text shows by its digest
        for pragma in self._pragmas:
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


def _begin(connection: Connection) -> None:
    immediate = connection.get_execution_options().get("stickslip_write", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")
