"""Transactions on the database (SQLite in the data directory, or PostgreSQL at a URL), statements,
documents and pages.

A write transaction excludes other writers from its first statement on, so it never conflicts at its
end, and needs no retries.

SQLAlchemy takes 0.1 ms of CPU to execute a statement that SQLite runs in 0.01 ms, and a lease and
its report execute thirty. So the queue has prepared statements, compiled once, and executed by the
driver directly. They have two limits: they return the driver's values (a Boolean is 0 or 1), and
trigger no SQLAlchemy events.
"""

import os
import threading
import time
from collections import namedtuple
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import Enum, auto
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import BaseModel
from sqlalchemy import (
    URL,
    Column,
    Connection,
    Dialect,
    Engine,
    Row,
    Select,
    Table,
    create_engine,
    event,
    text,
)
from sqlalchemy.exc import DBAPIError
from sqlalchemy.sql.base import Executable
from sqlalchemy.sql.compiler import SQLCompiler
from stickslip_schemas.documents.responses import Page

Clock = Callable[[], float]
"""Returns seconds since 1970 [s]."""

T = TypeVar("T")

BATCH = 5000
"""Number of values in one IN (...), and a twentieth of the rows of one executemany."""


class Role(Enum):
    """The purpose of a connection.

    Any number of coordinators may share a database; upkeep needs it exclusively.
    """

    coordinator = auto()
    upkeep = auto()
    visitor = auto()
    """A command that reads and writes a few rows beside the others."""


class Database:
    def __init__(self, reader: Engine, writer: Engine, *others: Engine) -> None:
        self._reader = reader
        self._writer = writer
        self._engines = {reader, writer, *others}
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

    def touch(self) -> AbstractContextManager[Connection]:
        """Connect for changes that may be lost, beside writers where the database has row locks.

        There each statement is a transaction, which must not wait for a row while it holds another:
        `with_for_update(skip_locked=True)`.
        """
        return self.write()

    def analyse(self) -> None:
        """Tell the database how large its tables have become, where it must know that to choose
        plans.
        """
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


def rows_with(
    connection: Connection, query: Select[Any], column: Column[Any], values: Iterable[Any]
) -> Iterator[Any]:
    """Yield the rows of `query` whose `column` has one of many values."""
    for batch in batches(values):
        yield from connection.execute(query.where(column.in_(batch)))


def insert_rows(
    connection: Connection, table: Table, columns: Sequence[str], rows: Iterable[tuple[Any, ...]]
) -> None:
    """Insert many rows with the driver's executemany, at a fifth of the cost of SQL expressions."""
    mark = {"qmark": "?", "format": "%s"}[connection.dialect.paramstyle]
    statement = f"INSERT INTO {table.name} ({', '.join(columns)}) VALUES ({', '.join([mark] * len(columns))})"
    for batch in batches(rows, 20 * BATCH):
        connection.exec_driver_sql(statement, batch)


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
    return datetime.fromtimestamp(seconds, UTC)


def document_of(model: type[M], row: Any, **more: Any) -> M:
    """Return a document with the values of a row, or of an object, for its fields, and with `more`.

    Times, in seconds since 1970, become dates in UTC.
    """
    found = {
        name: getattr(row, name)
        for name in model.model_fields
        if name not in more and hasattr(row, name)
    }
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
    """Return a page of the rows of `query`, ordered by the column `position`.

    `items` converts rows.
    """
    query = query.order_by(position.desc() if newest_first else position).limit(page.size + 1)
    if page.after is not None:
        query = query.where(position < page.after if newest_first else position > page.after)
    rows = connection.execute(query).all()
    shown = rows[: page.size]
    token = (
        str(getattr(shown[-1], position.key)) if len(rows) > page.size else None
    )  # one row more than a page
    return Page[T](items=tuple(items(shown)), next_page_token=token)


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
        reader = create_engine(url, connect_args={"timeout": 30}, pool_size=8, max_overflow=40)
        writer = create_engine(url, connect_args={"timeout": 30}, pool_size=1, max_overflow=0)
        for engine, begin in ((reader, "BEGIN"), (writer, "BEGIN IMMEDIATE")):
            event.listen(engine, "connect", partial(_prepare, pragmas))
            event.listen(
                engine, "begin", lambda connection, begin=begin: connection.exec_driver_sql(begin)
            )
        super().__init__(reader, writer)


def _prepare(pragmas: Iterable[str], connection: Any, _record: Any) -> None:
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


Values = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class _Compiled:
    sql: str
    names: tuple[str, ...]
    """The parameters in the order of the SQL."""
    defaults: Values
    lists: Mapping[str, str]
    """Parameters that are the values of an IN (...), each with a query for an empty list: `IN ()`
    is invalid. None where a list is one parameter, an array: the SQL is then the same for all
    lists, and the server plans it once."""
    mark: str


class Prepared:
    """A statement with its parameters as `bindparam`s, or SQL with `:parameters`.

    An expanding one takes a list.
    """

    def __init__(self, statement: Executable | str) -> None:
        self._statement = text(statement) if isinstance(statement, str) else statement
        self._compiled: dict[str, _Compiled] = {}
        columns = getattr(self._statement, "selected_columns", ())
        row = namedtuple("row", [column.key for column in columns], rename=True)  # type: ignore[misc]
        self._make: Any = row._make

    def rows(self, connection: Connection, values: Values | None = None) -> list[Any]:
        """Return the rows, named tuples of the selected columns."""
        return list(map(self._make, self.tuples(connection, values)))

    def tuples(self, connection: Connection, values: Values | None = None) -> list[Any]:
        """Return the rows as plain tuples, also those of a statement that is written as text."""
        return list(self._executed(connection, values or {}, lambda cursor: cursor.fetchall()))

    def scalar(self, connection: Connection, values: Values | None = None) -> Any:
        """Return the first column of the first row; None if there is no row."""
        row = self._executed(connection, values or {}, lambda cursor: cursor.fetchone())
        return None if row is None else row[0]

    def run(self, connection: Connection, values: Values) -> None:
        self._executed(connection, values, lambda _: None)

    def run_all(self, connection: Connection, values: Sequence[Values]) -> None:
        """Execute it with each of the values, if there are any.

        It must not have expanding parameters.
        """
        if not values:
            return
        compiled = self._compile(connection.dialect)
        names, defaults = compiled.names, compiled.defaults
        rows = [[row[name] if name in row else defaults[name] for name in names] for row in values]
        with _translated(connection, compiled.sql):
            if len(rows) == 1:  # psycopg sends many as a pipeline, which costs more
                _driver(connection).execute(compiled.sql, rows[0])
            else:
                _driver(connection).executemany(compiled.sql, rows)

    def _executed(self, connection: Connection, values: Values, fetch: Callable[[Any], Any]) -> Any:
        compiled = self._compile(connection.dialect)
        sql = compiled.sql
        for name, none in compiled.lists.items():
            count = len(values[name] if name in values else compiled.defaults[name])
            sql = sql.replace(_list_mark(name), ", ".join([compiled.mark] * count) or none)
        parameters: list[Any] = []
        for name in compiled.names:
            value = values[name] if name in values else compiled.defaults[name]
            if name in compiled.lists:
                parameters.extend(value)
            else:
                parameters.append(value)
        with _translated(connection, sql):
            return fetch(_driver(connection).execute(sql, parameters))

    def _compile(self, dialect: Dialect) -> _Compiled:
        compiled = self._compiled.get(dialect.name)
        if compiled is None:
            made = self._statement.compile(dialect=dialect)  # type: ignore[attr-defined]
            assert isinstance(made, SQLCompiler)
            names = tuple(made.positiontup or ())
            lists = {
                name: made.visit_empty_set_expr([made.binds[name].type])  # type: ignore[no-untyped-call]
                for name in dict.fromkeys(names)
                if made.binds[name].expanding
            }
            defaults = {
                name: value for name, value in made.params.items() if not made.binds[name].required
            }
            mark = {"qmark": "?", "format": "%s"}[dialect.paramstyle]
            sql = str(made)
            if dialect.name == "postgresql":
                for name in lists:
                    sql = sql.replace(f"NOT IN ({_list_mark(name)})", f"!= ALL ({mark})")
                    sql = sql.replace(f"IN ({_list_mark(name)})", f"= ANY ({mark})")
                lists = {}
            compiled = _Compiled(sql, names, defaults, lists, mark)
            self._compiled[dialect.name] = compiled
        return compiled


RowType = TypeVar("RowType", bound=tuple[Any, ...])


class RowQuery(Prepared, Generic[RowType]):
    """A prepared SELECT whose rows have a type: a NamedTuple with one field for each selected
    column, in order.
    """

    def __init__(self, row_type: type[RowType], statement: Select[Any]) -> None:
        super().__init__(statement)
        fields = row_type._fields  # type: ignore[attr-defined]  # of every NamedTuple
        selected = tuple(statement.selected_columns.keys())
        if fields != selected:
            raise TypeError(
                f"{row_type.__name__} has the fields {fields}, and the query selects {selected}"
            )
        self._make = row_type._make  # type: ignore[attr-defined]

    def rows(self, connection: Connection, values: Values | None = None) -> list[RowType]:
        return super().rows(connection, values)


class Counters(Prepared):
    """Adds to the counters of a table, whose last column is the counter and whose others are its
    key.
    """

    def __init__(self, table: Table) -> None:
        self._names = table.columns.keys()
        *keys, counter = (f'"{name}"' for name in self._names)
        super().__init__(
            f"INSERT INTO {table.name} ({', '.join([*keys, counter])}) VALUES (:{', :'.join(self._names)}) "
            f"ON CONFLICT ({', '.join(keys)}) DO UPDATE SET {counter} = {table.name}.{counter} + excluded.{counter}"
        )

    def add(self, connection: Connection, changes: Mapping[tuple[Any, ...], int]) -> None:
        """Add changes by key; a row that is missing is made."""
        self.run_all(
            connection,
            [dict(zip(self._names, (*key, n), strict=True)) for key, n in changes.items()],
        )


def _list_mark(name: str) -> str:
    return f"__[POSTCOMPILE_{name}]"


def _driver(connection: Connection) -> Any:
    return connection.connection.cursor()


@contextmanager
def _translated(connection: Connection, sql: str) -> Iterator[None]:
    """Raise the driver's errors as SQLAlchemy does."""
    base = connection.dialect.loaded_dbapi.Error
    try:
        yield
    except base as error:
        raise DBAPIError.instance(sql, None, error, base) from error
