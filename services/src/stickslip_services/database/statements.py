"""Statements that are compiled once and executed by the driver, and inserts of many rows.

SQLAlchemy takes 0.1 ms of CPU to execute a statement that SQLite runs in 0.01 ms, and a lease and
its report execute twenty. The statements of the queue are constants of their modules. Each is
compiled once for a dialect, and once for each size of its lists, and executed by the driver
directly. They have two limits: rows hold the driver's values (a Boolean is 0 or 1), and they
trigger no SQLAlchemy events.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import islice
from typing import Any, Generic, Protocol, TypeVar, cast

from sqlalchemy import BindParameter, Column, Connection, Select, Table, text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.sql.base import Executable
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.selectable import ReturnsRows

T = TypeVar("T")

BATCH = 4096
"""Number of values in one list. A power of 2, as the sizes of lists are (`_padded`)."""

INSERT_BATCH = 100_000
"""Number of rows of one executemany: larger batches are no faster and need more memory."""

Values = Mapping[str, object]
"""Values of the parameters of a statement, by name; of an expanding one, a list."""


class _Cursor(Protocol):
    """The part of a driver's cursor that statements use."""

    def execute(self, sql: str, parameters: Sequence[object]) -> object: ...
    def executemany(self, sql: str, parameters: Sequence[Sequence[object]]) -> object: ...
    def fetchall(self) -> list[tuple[Any, ...]]: ...
    def fetchone(self) -> tuple[Any, ...] | None: ...


class _Copy(Protocol):
    """An open COPY of psycopg."""

    def write_row(self, row: Sequence[object]) -> None: ...


class _CopyingCursor(Protocol):
    """The part of a cursor of psycopg that a COPY needs."""

    def copy(self, sql: str) -> AbstractContextManager[_Copy]: ...


def batches(items: Iterable[T], size: int = BATCH) -> Iterator[list[T]]:
    """Yield `items` in lists of at most `size`."""
    iterator = iter(items)
    while batch := list(islice(iterator, size)):
        yield batch


def rows_with(
    connection: Connection, query: Select[Any], column: Column[Any], values: Iterable[object]
) -> Iterator[Any]:
    """Yield the rows of `query` whose `column` has one of many values."""
    for batch in batches(values):
        yield from connection.execute(query.where(column.in_(batch)))


def insert_rows(
    connection: Connection, table: Table, columns: Sequence[str], rows: Iterable[Sequence[object]]
) -> None:
    """Insert many rows with the driver, at a fifth of the cost of SQL expressions or less."""
    insert = {"sqlite": _insert_many, "postgresql": _copy}[connection.dialect.name]
    insert(connection, table.name, columns, rows)


def _insert_many(
    connection: Connection, table: str, columns: Sequence[str], rows: Iterable[Sequence[object]]
) -> None:
    """Insert rows by executemany."""
    marks = ", ".join(["?"] * len(columns))
    sql = f"INSERT INTO {table} ({', '.join(columns)}) VALUES ({marks})"
    with _translated_errors(connection, sql):
        cursor = _cursor(connection)
        for batch in batches(rows, INSERT_BATCH):
            cursor.executemany(sql, batch)


def _copy(
    connection: Connection, table: str, columns: Sequence[str], rows: Iterable[Sequence[object]]
) -> None:
    """Insert rows by COPY: PostgreSQL's executemany takes twice the CPU time of both sides."""
    sql = f"COPY {table} ({', '.join(columns)}) FROM STDIN"
    cursor = cast("_CopyingCursor", connection.connection.cursor())
    with _translated_errors(connection, sql), cursor.copy(sql) as copy:
        for row in rows:
            copy.write_row(row)


def _padded(values: Sequence[object]) -> Sequence[object]:
    """Repeat the last value until the size of a list is a power of 2.

    Repeated values change nothing in `IN (...)`, and a statement then has 13 forms at most, which
    the database plans once each.
    """
    size = len(values)
    if size < 2:
        return values
    missing = (1 << (size - 1).bit_length()) - size
    return [*values, *[values[-1]] * missing]


class Statement:
    """A statement with its parameters as `bindparam`s, or SQL with `:parameters`.

    An expanding parameter takes a list.
    """

    def __init__(self, statement: Executable | str) -> None:
        self._statement = text(statement) if isinstance(statement, str) else statement
        self._compiled: dict[str, SQLCompiler] = {}
        self._expanded: dict[tuple[str, tuple[int, ...]], str] = {}

    def run(self, connection: Connection, values: Values) -> None:
        """Execute it."""
        with self._executed(connection, values):
            pass

    def run_all(self, connection: Connection, rows: Sequence[Values]) -> None:
        """Execute it with the values of each row, if there are any; it has no lists."""
        if not rows:
            return
        compiled = self._compile(connection)
        sql = compiled.string
        values = [_positional(compiled, row) for row in rows]
        with _translated_errors(connection, sql):
            cursor = _cursor(connection)
            if len(values) == 1:  # psycopg sends many as a pipeline, which costs more
                cursor.execute(sql, values[0])
            else:
                cursor.executemany(sql, values)

    @contextmanager
    def _executed(self, connection: Connection, values: Values) -> Iterator[_Cursor]:
        """Execute it, and yield the cursor with its rows."""
        compiled = self._compile(connection)
        lists: dict[str, Sequence[object]] = {}
        for name, parameter in compiled.binds.items():
            if parameter.expanding:
                lists[name] = _padded(cast("Sequence[object]", _value(name, parameter, values)))
        sql = self._expand(compiled, lists) if lists else compiled.string
        with _translated_errors(connection, sql):
            cursor = _cursor(connection)
            cursor.execute(sql, _positional(compiled, {**values, **lists}))
            yield cursor

    def _compile(self, connection: Connection) -> SQLCompiler:
        dialect = connection.dialect
        compiled = self._compiled.get(dialect.name)
        if compiled is None:
            result = self._statement.compile(dialect=dialect)  # type: ignore[attr-defined]
            assert isinstance(result, SQLCompiler)
            compiled = self._compiled[dialect.name] = result
        return compiled

    def _expand(self, compiled: SQLCompiler, lists: Mapping[str, Sequence[object]]) -> str:
        """Return the SQL for lists of these sizes."""
        sizes = tuple(len(values) for values in lists.values())
        sql = self._expanded.get((compiled.dialect.name, sizes))
        if sql is None:
            sql = compiled.construct_expanded_state({**compiled.params, **lists}).statement
            self._expanded[compiled.dialect.name, sizes] = sql
        return sql


def _value(name: str, parameter: BindParameter[object], values: Values) -> object:
    """Return the value of a parameter: a given one, or a constant of the statement."""
    if name in values or parameter.required:
        return values[name]
    return parameter.effective_value


def _positional(compiled: SQLCompiler, values: Values) -> list[object]:
    """Return the values in the order of the SQL.

    Raises KeyError if a value is missing.
    """
    parameters: list[object] = []
    for name in compiled.positiontup or ():
        parameter = compiled.binds[name]
        value = _value(name, parameter, values)
        if parameter.expanding:
            parameters.extend(cast("Sequence[object]", value))
        else:
            parameters.append(value)
    return parameters


RowType = TypeVar("RowType", bound=tuple[Any, ...])


class RowQuery(Statement, Generic[RowType]):
    """A query with typed rows: a NamedTuple with a field for each selected column, in order.

    Raises TypeError if the fields are not the columns of the statement. The columns of a statement
    in text are not known, so they are not checked.
    """

    def __init__(self, row_type: type[RowType], statement: Executable | str) -> None:
        super().__init__(statement)
        fields: tuple[str, ...] = row_type._fields  # type: ignore[attr-defined]  # of a NamedTuple
        if isinstance(statement, ReturnsRows):
            selected = tuple(statement.exported_columns.keys())
            if fields != selected:
                raise TypeError(
                    f"{row_type.__name__} has the fields {fields}, and the query selects {selected}"
                )
        self._row_of = row_type._make  # type: ignore[attr-defined]

    def rows(self, connection: Connection, values: Values | None = None) -> list[RowType]:
        """Return all rows."""
        with self._executed(connection, values or {}) as cursor:
            return list(map(self._row_of, cursor.fetchall()))

    def first(self, connection: Connection, values: Values | None = None) -> RowType | None:
        """Return the first row; None if there is no row."""
        with self._executed(connection, values or {}) as cursor:
            row = cursor.fetchone()
        return None if row is None else cast("RowType", self._row_of(row))

    def batched_rows(
        self, connection: Connection, name: str, items: Iterable[object]
    ) -> list[RowType]:
        """Return the rows for a list of any size: its parameter gets a batch at a time."""
        rows: list[RowType] = []
        for batch in batches(items):
            rows += self.rows(connection, {name: batch})
        return rows


class ValueQuery(Statement, Generic[T]):
    """A query of one column."""

    def values(self, connection: Connection, values: Values | None = None) -> list[T]:
        """Return the values of all rows."""
        with self._executed(connection, values or {}) as cursor:
            return [value for (value,) in cursor.fetchall()]

    def first(self, connection: Connection, values: Values | None = None) -> T | None:
        """Return the value of the first row; None if there is no row."""
        with self._executed(connection, values or {}) as cursor:
            row = cursor.fetchone()
        return None if row is None else row[0]


def _cursor(connection: Connection) -> _Cursor:
    return cast("_Cursor", connection.connection.cursor())


@contextmanager
def _translated_errors(connection: Connection, sql: str) -> Iterator[None]:
    """Raise the driver's errors as SQLAlchemy does."""
    base = connection.dialect.loaded_dbapi.Error
    try:
        yield
    except base as error:
        raise DBAPIError.instance(sql, None, error, base) from error
