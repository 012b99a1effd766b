"""Opening the database of a data directory, or refusing it in one sentence that says what to do."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from alembic.script import ScriptDirectory

from stickslip_services.database import migrate
from stickslip_services.database.database import Database
from stickslip_services.errors import DatabaseRefusedError

DATABASE_NAME = "coordinator.sqlite3"


@contextmanager
def opened(data: Path, *, durable: bool = True) -> Iterator[Database]:
    """Open the database of a data directory, brought up to date; make it where there is none.

    Raise DatabaseRefusedError where it is damaged or was made by a newer version.
    """
    path = data / DATABASE_NAME
    check(path)
    database = Database(path, durable=durable)
    try:
        with database.write() as connection:
            migrate.upgrade(connection)
        yield database
    finally:
        database.close()


def check(path: Path) -> None:
    """Raise DatabaseRefusedError where a database cannot be used; one that is not there can be made."""
    if not path.exists():
        return
    revision = ""
    try:
        with closing(sqlite3.connect(path, timeout=30)) as connection:
            (found,) = connection.execute("PRAGMA quick_check(1)").fetchone()
            if found == "ok" and connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchone():
                (revision,) = connection.execute("SELECT version_num FROM alembic_version").fetchone()
    except (sqlite3.OperationalError, TypeError) as error:
        if isinstance(error, sqlite3.OperationalError) and "no such table" not in str(error):
            raise DatabaseRefusedError(f"{path} cannot be opened: {error}") from error
        raise DatabaseRefusedError(
            f"{path} is not a database of stickslip: move it away, or name another --data"
        ) from error
    except sqlite3.DatabaseError as error:
        found = str(error)
    if found not in ("ok", "") and not revision:
        raise DatabaseRefusedError(
            f"{path} is damaged ({found.splitlines()[-1]}): move it away and run "
            f"`stickslip reindex --data {path.parent}`, which finds the datasets in the store again"
        )
    known = {script.revision for script in ScriptDirectory(str(migrate.MIGRATIONS)).walk_revisions()}
    if revision and revision not in known:
        raise DatabaseRefusedError(
            f"{path} was made by a newer stickslip (schema {revision}, and this version knows up to {max(known)}): "
            "install that version again, or name another --data"
        )
