"""SQLite: a file in the data directory, for one coordinator."""

import os
from collections.abc import Iterable, Iterator
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
    "journal_size_limit=67108864",  # the log of a big plan does not stay that big
)


class SqliteDatabase(Database):
    """Transactions on one file. A write takes SQLite's write lock with its first statement (`BEGIN IMMEDIATE`)."""

    def __init__(self, path: Path, *, durable: bool = True) -> None:
        _close_to_others(path)
        # FULL: accepted jobs and dataset versions survive a power cut. A commit costs an fsync; leases and reports
        # come in batches, so there are only a few a second.
        pragmas = (*_PRAGMAS, "synchronous=FULL" if durable else "synchronous=OFF")
        url = URL.create("sqlite+pysqlite", database=str(path))
        reader = create_engine(url, connect_args={"timeout": 30}, pool_size=8, max_overflow=40)
        writer = create_engine(url, connect_args={"timeout": 30}, pool_size=1, max_overflow=0)
        for engine, begin in ((reader, "BEGIN"), (writer, "BEGIN IMMEDIATE")):
            event.listen(engine, "connect", partial(_prepare, pragmas))
            event.listen(engine, "begin", lambda connection, begin=begin: connection.exec_driver_sql(begin))
        super().__init__(reader, writer)

    @contextmanager
    def write(self) -> Iterator[Connection]:
        with self._writing, self._writer.begin() as connection:
            yield connection


def _prepare(pragmas: Iterable[str], connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # the listeners begin transactions, not the driver
    connection.text_factory = partial(str, encoding="utf-8", errors="replace")  # damaged text shows by its digest
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
