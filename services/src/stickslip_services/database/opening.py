"""Opening and migration of a coordinator's database, or a refusal that says how to go on."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib.util import find_spec
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, inspect, text
from sqlalchemy.exc import DBAPIError
from stickslip_schemas.format.manifest import MANIFEST_NAME
from stickslip_schemas.installation import install_hint
from stickslip_schemas.store import open_store

from stickslip_services.database.database import Database, Role, SqliteDatabase
from stickslip_services.errors import DatabaseRefusedError
from stickslip_services.settings import Settings

MIGRATIONS = Path(__file__).parent / "migrations"


def connect(settings: Settings, role: Role = Role.coordinator) -> Database:
    """Return the database of a coordinator, unchanged.

    Raises DatabaseRefusedError if its driver is missing.
    """
    url = settings.database_url
    if url is None:
        return SqliteDatabase(settings.database_path, durable=settings.durable)
    if find_spec("psycopg") is None:
        raise DatabaseRefusedError(
            f"the database {settings.database_name} needs psycopg, which is not installed: "
            + install_hint("stickslip", "server", "postgresql")
        )
    from stickslip_services.database.postgresql import PostgresqlDatabase

    return PostgresqlDatabase(url, durable=settings.durable, role=role)


def migration(connection: Connection) -> Config:
    """Return Alembic's configuration for an open transaction."""
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    return config


def upgrade(connection: Connection) -> None:
    """Apply all pending migrations; if one fails, none is applied."""
    command.upgrade(migration(connection), "head")


@contextmanager
def opened(settings: Settings, role: Role) -> Iterator[Database]:
    """Open the database of a coordinator, and migrate it, or make it if there is none.

    Raises DatabaseRefusedError if it is damaged, has an unknown schema, or refuses the role.
    """
    check(settings, role)
    database = connect(settings, role)
    try:
        with database.write() as connection:
            upgrade(connection)
        yield database
    finally:
        database.close()


def check(settings: Settings, role: Role, *, with_store: bool = False) -> bool:
    """Return whether the database exists.

    Raises DatabaseRefusedError if the role cannot use the database. With `with_store`, it also
    refuses a missing database if the store holds datasets, because the database was lost.
    """
    if settings.data.exists() and not settings.data.is_dir():
        raise DatabaseRefusedError(f"--data must be a directory, and {settings.data} is a file")
    if settings.database_url is None:
        revision = _sqlite_revision(settings.database_path)
    else:
        revision = _postgresql_revision(settings, role)
    name = settings.database_name
    if revision is None and with_store and _has_versions(settings):
        options = {"--store": settings.store, "--database": settings.database}
        same = " and ".join(option for option, value in options.items() if value is not None)
        raise DatabaseRefusedError(
            f"{settings.store_place} holds datasets, and the database {name} is gone: run "
            "`stickslip reindex --data "
            f"{settings.data}`{same and f' with the same {same}'} to find them again"
        )
    known = {script.revision for script in ScriptDirectory(str(MIGRATIONS)).walk_revisions()}
    if revision is not None and revision.startswith("0001") and revision not in known:
        # The tables of 0.1.0 before its release: there is no migration from them.
        raise DatabaseRefusedError(
            f"{name} was made by an earlier state of this version of stickslip, whose tables were "
            "others (schema "
            f"{revision}). Its datasets are in the store {settings.store_place}: "
            f"{_remedy(settings)}"
        )
    if revision is not None and revision not in known:
        raise DatabaseRefusedError(
            f"{name} has the schema {revision}, and this version of stickslip knows {max(known)}: "
            "install the version "
            f"that made it again, or name another {settings.database_option}"
        )
    return revision is not None


def _remedy(settings: Settings) -> str:
    """Return how to find the datasets of a store again with a new database."""
    if settings.database_url is None:
        return (
            f"move {settings.database_path} away and run `stickslip reindex --data "
            f"{settings.data}`, which lists them "
            "again; results that no dataset has are computed again"
        )
    return (
        "name an empty database with --database, and run `stickslip reindex` with it, which lists "
        "them again; "
        "results that no dataset has are computed again"
    )


def _has_versions(settings: Settings) -> bool:
    """Return whether a store holds datasets.

    Raises DatabaseRefusedError if the store is out of reach.
    """
    try:
        return next(open_store(settings.store_place).versions(MANIFEST_NAME), None) is not None
    except OSError as error:
        raise DatabaseRefusedError(
            f"the database {settings.database_name} is new, and the store {settings.store_place} "
            "cannot be asked "
            f"whether it holds datasets: {error.strerror or error}"
        ) from error


def _sqlite_revision(path: Path) -> str | None:
    """Return the schema revision of a file; None if it is missing or empty."""
    if not path.exists():
        return None
    revision = None
    try:
        with closing(sqlite3.connect(path, timeout=30)) as connection:
            (finding,) = connection.execute("PRAGMA quick_check(1)").fetchone()
            if (
                finding == "ok"
                and connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchone()
            ):
                (revision,) = connection.execute(
                    "SELECT version_num FROM alembic_version"
                ).fetchone()
    except (sqlite3.OperationalError, TypeError) as error:
        if isinstance(error, sqlite3.OperationalError) and "no such table" not in str(error):
            raise DatabaseRefusedError(f"{path} cannot be opened: {error}") from error
        raise DatabaseRefusedError(
            f"{path} is not a database of stickslip: move it away, or name another --data"
        ) from error
    except sqlite3.DatabaseError as error:
        finding = str(error)
    if finding != "ok":
        raise DatabaseRefusedError(
            f"{path} is damaged ({finding.splitlines()[-1]}): move it away and run "
            f"`stickslip reindex --data {path.parent}`, which finds the datasets in the store again"
        )
    return revision


def _postgresql_revision(settings: Settings, role: Role) -> str | None:
    """Return the schema revision of a database; None if it is empty."""
    name = settings.database_name
    if settings.database_path.exists():
        raise DatabaseRefusedError(
            f"the queue must be in {name}, and {settings.database_path} holds another one: move "
            "that file away"
        )
    database = connect(settings, role)
    try:
        with (
            database.write() as connection
        ):  # it is refused where another role has the database exclusively
            tables = inspect(connection).get_table_names()
            encoding = connection.scalar(text("SHOW server_encoding"))
            if encoding != "UTF8":
                raise DatabaseRefusedError(
                    f"the encoding of the database {name} must be UTF8, and is {encoding}: "
                    "make another one with `createdb --encoding UTF8 --template template0`"
                )
            if not tables:
                if not connection.scalar(
                    text("SELECT has_schema_privilege(current_schema(), 'CREATE')")
                ):
                    raise DatabaseRefusedError(
                        f"its user may not make tables in the database {name}: make the user its "
                        "owner, "
                        "for example with `createdb --owner`"
                    )
                return None
            if "alembic_version" not in tables or "job_tasks" not in tables:
                raise DatabaseRefusedError(
                    f"{name} is not a database of stickslip: give it one of its own, which is "
                    "empty, with --database"
                )
            return str(connection.scalar(text("SELECT version_num FROM alembic_version")))
    except DBAPIError as error:
        raise DatabaseRefusedError(
            f"{name} cannot be opened: {str(error.orig).splitlines()[0]}"
        ) from error
    finally:
        database.close()
