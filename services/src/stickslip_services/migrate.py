"""Bringing a database up to date, and telling whether tables and migrations agree."""

from pathlib import Path

from alembic import command
from alembic.config import Config
from sqlalchemy import URL

_MIGRATIONS = Path(__file__).parent / "migrations"


def config(url: URL) -> Config:
    """Return Alembic's configuration for a database."""
    made = Config()
    made.set_main_option("script_location", str(_MIGRATIONS).replace("%", "%%"))
    made.set_main_option("sqlalchemy.url", url.render_as_string(hide_password=False).replace("%", "%%"))
    made.set_main_option("path_separator", "os")
    return made


def upgrade(url: URL) -> None:
    """Apply all migrations that the database has not had yet."""
    command.upgrade(config(url), "head")


def check(url: URL) -> None:
    """Raise where the database, after all migrations, differs from `tables`."""
    command.check(config(url))
