"""Migration of a database, and the check that tables and migrations agree."""

from pathlib import Path

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection

MIGRATIONS = Path(__file__).parent / "migrations"


def config(connection: Connection) -> Config:
    """Return Alembic's configuration for an open transaction."""
    made = Config()
    made.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    made.set_main_option("path_separator", "os")
    made.attributes["connection"] = connection
    return made


def upgrade(connection: Connection) -> None:
    """Apply all pending migrations; if one fails, none is applied."""
    command.upgrade(config(connection), "head")


def check(connection: Connection) -> None:
    """Raise where the database, after all migrations, differs from `tables`."""
    command.check(config(connection))
