"""The migrations make the tables that the code uses."""

import re
from collections.abc import Callable

import pytest
from alembic import command
from alembic.util import CommandError
from sqlalchemy import inspect, text
from stickslip_services.database.database import Database
from stickslip_services.database.opening import migration, upgrade
from stickslip_services.database.tables import metadata

pytestmark = pytest.mark.databases

INDEXES = {
    "sqlite": "SELECT name, sql FROM sqlite_master WHERE type = 'index' ORDER BY name",
    "postgresql": (
        "SELECT indexname AS name, indexdef AS sql FROM pg_indexes "
        "WHERE schemaname = 'public' ORDER BY 1"
    ),
}


def _plain(sql: str | None) -> str:
    """Return the definition of an index without casts and brackets: PostgreSQL writes the same in
    several ways.
    """
    return re.sub(r"::[a-z ]+(\[\])?|[()]", "", sql or "")


def test_tables_are_those_of_the_migrations(empty_database: Callable[[], Database]) -> None:
    with empty_database().write() as connection:
        upgrade(connection)
        command.check(migration(connection))


def test_indexes_are_partial_where_the_tables_say_so(
    empty_database: Callable[[], Database],
) -> None:
    """Alembic's check does not look at the conditions of indexes."""
    statements = []
    for name in ("migrated", "direct"):
        with empty_database().write() as connection:
            if name == "migrated":
                upgrade(connection)
            else:
                metadata.create_all(connection)
            rows = connection.execute(text(INDEXES[connection.dialect.name]))
            statements.append(
                [_plain(row.sql) for row in rows if "alembic_version" not in row.name]
            )
    assert statements[0] == statements[1]
    assert sum("WHERE" in sql for sql in statements[0]) == 7


def test_a_migration_that_fails_leaves_nothing(empty_database: Callable[[], Database]) -> None:
    database = empty_database()

    def fail_at_the_end() -> None:
        with database.write() as connection:
            upgrade(connection)
            raise CommandError("the power is gone")

    with pytest.raises(CommandError):
        fail_at_the_end()
    with database.read() as connection:
        assert inspect(connection).get_table_names() == []
