"""The migrations make the tables that the code uses."""

from pathlib import Path

import pytest
from alembic.util import CommandError
from sqlalchemy import text
from stickslip_services.database import migrate
from stickslip_services.database.database import Database
from stickslip_services.database.tables import metadata


def test_tables_are_those_of_the_migrations(tmp_path: Path) -> None:
    database = Database(tmp_path / "migrated.sqlite3", durable=False)
    with database.write() as connection:
        migrate.upgrade(connection)
        migrate.check(connection)
    database.close()


def test_indexes_are_partial_where_the_tables_say_so(tmp_path: Path) -> None:
    """Alembic's check does not look at the conditions of indexes."""
    statements = []
    for name in ("migrated", "direct"):
        database = Database(tmp_path / f"{name}.sqlite3", durable=False)
        with database.write() as connection:
            if name == "migrated":
                migrate.upgrade(connection)
            else:
                metadata.create_all(connection)
            rows = connection.execute(text("SELECT name, sql FROM sqlite_master WHERE type = 'index' ORDER BY name"))
            statements.append([row for row in rows if row.name != "sqlite_autoindex_alembic_version_1"])
        database.close()
    assert statements[0] == statements[1]
    assert sum("WHERE" in (row.sql or "") for row in statements[0]) == 4


def test_a_migration_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    database = Database(tmp_path / "data.sqlite3", durable=False)

    def fail_at_the_end() -> None:
        with database.write() as connection:
            migrate.upgrade(connection)
            raise CommandError("the power is gone")

    with pytest.raises(CommandError):
        fail_at_the_end()
    with database.read() as connection:
        assert connection.execute(text("SELECT name FROM sqlite_master")).all() == []
    database.close()
