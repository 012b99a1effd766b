"""A PostgreSQL server for tests, in a temporary directory, with a Unix socket.

It ends with the process.
"""

import ctypes
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from itertools import count
from pathlib import Path

import psycopg
from stickslip_services.database.database import Role
from stickslip_services.database.opening import opened
from stickslip_services.database.tables import metadata
from stickslip_services.settings import Settings

_PR_SET_PDEATHSIG = 1
_OPTIONS = (
    *(
        "listen_addresses=",
        "fsync=off",
        "synchronous_commit=off",
        "full_page_writes=off",
        "shared_buffers=64MB",
    ),
    *("wal_level=minimal", "max_wal_senders=0", "autovacuum=off"),
)
"""Without TCP, and without waiting for the disk."""
_INITIAL = (
    "--username=stickslip",
    "--auth=trust",
    "--encoding=UTF8",
    "--locale=C.UTF-8",
    "--no-sync",
    "--no-instructions",
)


def find_programs() -> Path | None:
    """Return the directory of PostgreSQL's programs, None if they are not installed."""
    folders = [Path(path).parent for path in (shutil.which("initdb"),) if path]
    versions = sorted(
        Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda path: int(path.parts[4])
    )
    folders += [path.parent for path in reversed(versions)]
    return next((path for path in folders if (path / "postgres").exists()), None)


class PostgresqlServer:
    """A running server."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._numbers = count()

    def url(self, database: str) -> str:
        """Return the URL of a database."""
        return f"postgresql://stickslip@/{database}?host={self._directory}"

    def empty(self) -> str:
        """Make a database and return its URL."""
        name = f"test{next(self._numbers)}"
        self.execute(f"CREATE DATABASE {name} TEMPLATE template0 STRATEGY file_copy")
        return self.url(name)

    def clean(self) -> str:
        """Return the URL of a migrated database without rows, always the same one.

        It has no rows and counts from 1 again. Who still uses it is thrown out.
        """
        deletions = [
            f"{'TRUNCATE' if table.name == 'audit_log' else 'DELETE FROM'} {table.name}"
            for table in reversed(metadata.sorted_tables)
        ]
        with psycopg.connect(self._migrated, autocommit=True) as connection:
            connection.execute(
                "SELECT pg_terminate_backend(pid, 5000) FROM pg_stat_activity "
                "WHERE datname = current_database() AND pid != pg_backend_pid()"
            )
            connection.execute(
                "; ".join([*deletions, "SELECT setval(seqrelid, 1, false) FROM pg_sequence"])
            )
        return self._migrated

    def execute(self, statement: str, database: str = "postgres") -> None:
        """Execute a statement outside any transaction."""
        with psycopg.connect(self.url(database), autocommit=True) as connection:
            connection.execute(statement)

    @cached_property
    def _migrated(self) -> str:
        url = self.empty()
        with opened(Settings.chosen(database=url), Role.visitor):
            return url


@contextmanager
def postgresql_server(programs: Path) -> Iterator[PostgresqlServer]:
    """Run a server. It refuses to run as root, so root runs it as `nobody`."""
    user = "nobody" if os.geteuid() == 0 else None
    directory = Path(tempfile.mkdtemp(prefix="stickslip-postgresql-"))
    try:
        if user:
            shutil.chown(directory, user)
        data = directory / "data"
        subprocess.run(
            [programs / "initdb", "--pgdata", data, *_INITIAL],
            user=user,
            cwd=directory,
            check=True,
            stdout=subprocess.DEVNULL,
        )
        options = [part for option in _OPTIONS for part in ("-c", option)]
        with (directory / "log").open("wb") as log:
            process = subprocess.Popen(
                [programs / "postgres", "-D", data, "-k", directory, *options],
                user=user,
                cwd=directory,
                stdout=log,
                stderr=log,
                preexec_fn=_die_with_parent,
            )
        try:
            server = PostgresqlServer(directory)
            _wait_until_ready(server, process, directory / "log")
            yield server
        finally:
            process.send_signal(signal.SIGQUIT)
            process.wait()
    finally:
        shutil.rmtree(directory)


def _wait_until_ready(
    server: PostgresqlServer, process: "subprocess.Popen[bytes]", log: Path
) -> None:
    deadline = time.monotonic() + 120
    while True:
        try:
            server.execute("SELECT 1")
        except psycopg.OperationalError:
            if process.poll() is not None or time.monotonic() > deadline:
                raise AssertionError(f"PostgreSQL does not start: {log.read_text()}") from None
            time.sleep(0.05)
        else:
            return


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGQUIT)
