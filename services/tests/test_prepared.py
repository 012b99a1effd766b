"""Prepared statements do what SQLAlchemy does with the same statement."""

from collections.abc import Callable

import pytest
from sqlalchemy import bindparam, insert, select, update
from sqlalchemy.exc import IntegrityError, OperationalError, ProgrammingError
from stickslip_services.database.database import Database, Prepared
from stickslip_services.database.tables import metadata, previews

SOME = (
    select(previews)
    .where(previews.c.task.in_(bindparam("b_tasks", expanding=True)))
    .order_by(previews.c.task)
)
OTHERS = select(previews.c.task).where(previews.c.task.not_in(bindparam("b_tasks", expanding=True)))


pytestmark = pytest.mark.databases


@pytest.fixture
def filled(empty_database: Callable[[], Database]) -> Database:
    made = empty_database()
    with made.write() as connection:
        metadata.create_all(connection)
        Prepared(insert(previews)).run_all(
            connection, [{"task": task, "digest": f"d{task}"} for task in range(5)]
        )
    return made


def test_rows_have_the_names_of_their_columns(filled: Database) -> None:
    with filled.read() as connection:
        rows = Prepared(SOME).rows(connection, {"b_tasks": [3, 1]})
        assert [(row.task, row.digest) for row in rows] == connection.execute(
            SOME, {"b_tasks": [3, 1]}
        ).all()
        assert len(rows) == 2


def test_a_list_may_be_empty(filled: Database) -> None:
    with filled.read() as connection:
        assert Prepared(SOME).tuples(connection, {"b_tasks": []}) == []
        assert len(Prepared(OTHERS).tuples(connection, {"b_tasks": []})) == 5
        assert Prepared(SOME).scalar(connection, {"b_tasks": []}) is None


def test_values_in_the_statement_are_kept_and_missing_ones_are_an_error(filled: Database) -> None:
    statement = Prepared(
        update(previews).where(previews.c.task == bindparam("b_task")).values(digest="new")
    )
    with filled.write() as connection:
        statement.run(connection, {"b_task": 2})
        assert (
            Prepared("SELECT digest FROM previews WHERE task = :task").scalar(
                connection, {"task": 2}
            )
            == "new"
        )
        with pytest.raises(KeyError, match="b_task"):
            statement.run(connection, {})


def test_errors_are_those_of_sqlalchemy(filled: Database) -> None:
    with filled.write() as connection, pytest.raises(IntegrityError):
        Prepared(insert(previews)).run(connection, {"task": 1, "digest": "twice"})
    with filled.read() as connection, pytest.raises((OperationalError, ProgrammingError)):
        Prepared("SELECT nothing FROM nowhere").tuples(connection)
