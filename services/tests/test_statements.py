"""Statements do what SQLAlchemy does with the same statement."""

from collections.abc import Callable
from typing import NamedTuple

import pytest
from sqlalchemy import bindparam, insert, select, update
from sqlalchemy.exc import IntegrityError, OperationalError, ProgrammingError
from stickslip_services.database.database import Database
from stickslip_services.database.statements import (
    BATCH,
    RowQuery,
    Statement,
    ValueQuery,
    insert_rows,
)
from stickslip_services.database.tables import metadata, previews, tasks, uploads


class Preview(NamedTuple):
    task: int
    digest: str


CHOSEN = (
    select(previews)
    .where(previews.c.task.in_(bindparam("b_tasks", expanding=True)))
    .order_by(previews.c.task)
)
REMAINING = select(previews.c.task).where(
    previews.c.task.not_in(bindparam("b_tasks", expanding=True))
)
FIXED = select(previews.c.task).where(previews.c.digest.in_(["d1", "d4", "nothing"]))

pytestmark = pytest.mark.databases


@pytest.fixture
def filled(empty_database: Callable[[], Database]) -> Database:
    database = empty_database()
    with database.write() as connection:
        metadata.create_all(connection)
        Statement(insert(previews)).run_all(
            connection, [{"task": task, "digest": f"d{task}"} for task in range(5)]
        )
    return database


def test_rows_have_the_names_of_their_columns(filled: Database) -> None:
    with filled.read() as connection:
        rows = RowQuery(Preview, CHOSEN).rows(connection, {"b_tasks": [3, 1]})
        assert rows == [Preview(1, "d1"), Preview(3, "d3")]
        assert [tuple(row) for row in rows] == [
            tuple(row) for row in connection.execute(CHOSEN, {"b_tasks": [3, 1]})
        ]


def test_a_row_type_with_other_fields_is_refused() -> None:
    class Wrong(NamedTuple):
        digest: str
        task: int

    with pytest.raises(TypeError, match="Wrong has the fields"):
        RowQuery(Wrong, CHOSEN)


@pytest.mark.parametrize("size", [0, 1, 2, 3, 4, 5, 2000])
def test_a_list_may_have_any_size(filled: Database, size: int) -> None:
    """The size of a list is rounded up to a power of 2: no row may come twice, and none be lost."""
    wanted = list(range(size))
    expected = wanted[:5]
    with filled.read() as connection:
        for _ in range(2):  # the second time the SQL is known
            rows = RowQuery(Preview, CHOSEN).rows(connection, {"b_tasks": wanted})
            assert [row.task for row in rows] == expected
        remaining = ValueQuery[int](REMAINING).values(connection, {"b_tasks": wanted})
        assert sorted(remaining) == [task for task in range(5) if task not in expected]


def test_lists_beyond_a_batch_are_read_in_batches(filled: Database) -> None:
    with filled.read() as connection:
        items = [*range(10, BATCH + 10), 2]
        rows = RowQuery(Preview, CHOSEN).batched_rows(connection, "b_tasks", items)
        assert rows == [Preview(2, "d2")]


def test_values_in_the_statement_are_kept_and_missing_ones_are_an_error(filled: Database) -> None:
    statement = Statement(
        update(previews).where(previews.c.task == bindparam("b_task")).values(digest="new")
    )
    digest: ValueQuery[str] = ValueQuery("SELECT digest FROM previews WHERE task = :task")
    with filled.write() as connection:
        assert sorted(ValueQuery[int](FIXED).values(connection)) == [1, 4]
        statement.run(connection, {"b_task": 2})
        assert digest.first(connection, {"task": 2}) == "new"
        assert digest.first(connection, {"task": 7}) is None
        with pytest.raises(KeyError, match="b_task"):
            statement.run(connection, {})


def test_errors_are_those_of_sqlalchemy(filled: Database) -> None:
    with filled.write() as connection, pytest.raises(IntegrityError):
        Statement(insert(previews)).run(connection, {"task": 1, "digest": "twice"})
    with filled.read() as connection, pytest.raises((OperationalError, ProgrammingError)):
        ValueQuery[int]("SELECT nothing FROM nowhere").values(connection)


def test_many_rows_are_inserted_with_any_characters(filled: Database) -> None:
    """PostgreSQL gets them by COPY, which has separators and a mark for NULL in its text."""
    texts = ["", "\\N", "tab\there", "line\nbreak\r", "back\\slash", "na\u00efve \U0001f9f5", "'"]
    rows = [(bytes([number, 0, 92, 10]), text, None) for number, text in enumerate(texts)]
    columns = ("project", "digest")
    with filled.write() as connection:
        insert_rows(connection, uploads, columns, [])
        insert_rows(connection, uploads, columns, [(text, "x") for text in texts])
        assert set(ValueQuery[str]("SELECT project FROM uploads").values(connection)) == {*texts}

        names = ("seq", "key", "reason", "preview", "expires_at")
        fixed = ("stage", "kind", "build", "payload", "message", "state")
        insert_rows(
            connection,
            tasks,
            (*names, *fixed, "payload_digest", "waiting_on"),
            [
                (number, key, reason, bool(number % 2), 0.1, *[text] * len(fixed), 2**62, 1)
                for number, (key, text, reason) in enumerate(rows)
            ],
        )
        inserted = connection.execute(select(tasks).order_by(tasks.c.seq)).all()
        for number, (row, (key, text, _)) in enumerate(zip(inserted, rows, strict=True)):
            assert (row.key, row.payload, row.reason) == (key, text, None)
            assert (row.preview, row.expires_at) == (bool(number % 2), 0.1)
            assert (row.payload_digest, row.attempts) == (2**62, 0), "a default"


def test_many_rows_are_inserted_all_or_not_at_all(filled: Database) -> None:
    with pytest.raises(IntegrityError), filled.write() as connection:
        insert_rows(connection, previews, ("task", "digest"), [(7, "new"), (1, "twice")])
    with filled.read() as connection:
        assert ValueQuery[int]("SELECT count(*) FROM previews").first(connection) == 5
