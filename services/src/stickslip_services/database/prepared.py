"""Prepared statements of the queue: compiled once, and executed by the driver directly.

SQLAlchemy takes 0.1 ms of CPU to execute a statement that SQLite runs in 0.01 ms, and a lease and its report execute
thirty. A prepared statement has two limits: it returns the driver's values (a Boolean is 0 or 1), and triggers no
SQLAlchemy events.
"""

from collections import namedtuple
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Dialect, Table, text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.sql.base import Executable
from sqlalchemy.sql.compiler import SQLCompiler

Values = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class _Compiled:
    sql: str
    names: tuple[str, ...]
    """The parameters in the order of the SQL."""
    defaults: Values
    lists: Mapping[str, str]
    """Parameters that are the values of an IN (...), each with a query for an empty list: `IN ()` is invalid. None
    where a list is one parameter, an array: the SQL is then the same for all lists, and the server plans it once."""
    mark: str


class Prepared:
    """A statement with its parameters as `bindparam`s, or SQL with `:parameters`; an expanding one takes a list."""

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
        """Execute it with each of the values, if there are any; it must not have expanding parameters."""
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
            defaults = {name: value for name, value in made.params.items() if not made.binds[name].required}
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


class Counters(Prepared):
    """Adds to the counters of a table, whose last column is the counter and whose others are its key."""

    def __init__(self, table: Table) -> None:
        self._names = table.columns.keys()
        *keys, counter = (f'"{name}"' for name in self._names)
        super().__init__(
            f"INSERT INTO {table.name} ({', '.join([*keys, counter])}) VALUES (:{', :'.join(self._names)}) "
            f"ON CONFLICT ({', '.join(keys)}) DO UPDATE SET {counter} = {table.name}.{counter} + excluded.{counter}"
        )

    def add(self, connection: Connection, changes: Mapping[tuple[Any, ...], int]) -> None:
        """Add changes by key; a row that is missing is made."""
        self.run_all(connection, [dict(zip(self._names, (*key, n), strict=True)) for key, n in changes.items()])


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
