"""Opening the database of a data directory, or refusing it in one sentence that says what to do."""

import fcntl
import os
import sqlite3
import time
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


def check(path: Path, store: Path | None = None) -> None:
    """Raise DatabaseRefusedError where a database cannot be used.

    One that is not there can be made, unless there are datasets in the `store`: then it was lost.
    """
    if not path.exists():
        if store is not None and next(store.glob("datasets/*/v*/manifest.json"), None) is not None:
            raise DatabaseRefusedError(
                f"{store} holds datasets, and the database {path} is gone: run `stickslip reindex --data "
                f"{path.parent}` to find them again"
            )
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


@contextmanager
def locked(data: Path) -> Iterator[int]:
    """Hold the lock of a data directory; the coordinator inherits it, so that it is held while one of them lives.

    Yield its file descriptor; raise DatabaseRefusedError where another process holds it.
    """
    data.mkdir(parents=True, exist_ok=True)
    path = data / "lock"
    with path.open("a+") as file:
        deadline = time.monotonic() + 10
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                holder = path.read_text(encoding="utf-8").strip()
                # If the holder was killed, its coordinator is about to follow it.
                if _is_alive(holder) or time.monotonic() > deadline:
                    message = f"{path.parent} is in use by another `stickslip up` or coordinator (pid {holder})"
                    raise DatabaseRefusedError(message) from None
                time.sleep(0.1)
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        os.set_inheritable(file.fileno(), True)
        yield file.fileno()


def _is_alive(pid: str) -> bool:
    if not pid.isdecimal():
        return False
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
