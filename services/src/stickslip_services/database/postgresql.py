"""PostgreSQL: one database for any number of coordinators.

Writers exclude each other by one advisory lock, as on SQLite, so the queue never sees an unfinished
change of another coordinator. One writer at a time suffices for a thousand cores. The statement
that takes the lock also reads the database's clock and announces the change to the other
coordinators; PostgreSQL delivers that with the commit.
"""

import asyncio
import logging
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any

import psycopg
from psycopg.abc import Buffer
from psycopg.types.string import StrDumper
from sqlalchemy import URL, Connection, create_engine, event
from sqlalchemy.pool import ConnectionPoolEntry

from stickslip_services.database.database import Database, Role
from stickslip_services.errors import DatabaseRefusedError

Driver = psycopg.Connection[tuple[object, ...]]

logger = logging.getLogger(__name__)

_LOCKS = 0x736C6970
"""First number of our advisory locks, "slip". The second is 1 for the writer, 2 for every connected
process.
"""

_CHANNEL = "stickslip"

_CONNECT = {
    "application_name": "stickslip",
    "client_encoding": "utf8",
    "connect_timeout": 10,
    # The loss of a peer machine is detected within a minute.
    "keepalives_idle": 30,
    "keepalives_interval": 10,
    "keepalives_count": 3,
}

_WRITER_SETTINGS = (
    "lock_timeout = '30s'",
    # A process that stops in a write (SIGSTOP, a lost network) must not block the others forever.
    "idle_in_transaction_session_timeout = '60s'",
    "tcp_keepalives_idle = 30",
    "tcp_keepalives_interval = 10",
    "tcp_keepalives_count = 3",
)

_BEGIN = (
    f"SELECT pg_advisory_xact_lock({_LOCKS}, 1), pg_notify('{_CHANNEL}', %s), "
    "CAST(extract(epoch FROM clock_timestamp()) AS double precision)"
)
_ENTER = {
    Role.coordinator: f"SELECT pg_try_advisory_lock_shared({_LOCKS}, 2)",
    Role.upkeep: f"SELECT pg_try_advisory_lock({_LOCKS}, 2)",
    Role.visitor: "SELECT true",
}
_REFUSALS = {
    Role.coordinator: "`stickslip rm`, `gc` or `reindex` is at work on the database {}: wait until "
    "it has ended",
    Role.upkeep: "the database {} is in use by a coordinator, or by another `stickslip rm`, `gc` "
    "or `reindex`: stop it first",
}
_COUNT_OTHER_USERS = (
    f"SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND classid = {_LOCKS} "
    "AND objid = 2 AND objsubid = 2 AND pid != pg_backend_pid() "
    "AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"
)


class PostgresqlDatabase(Database):
    """Transactions on one PostgreSQL database.

    Reads see a snapshot (REPEATABLE READ). Writes go through one connection, which also holds the
    lock of the role. The first write raises DatabaseRefusedError if the role is refused.
    """

    def __init__(self, url: URL, *, durable: bool = True, role: Role = Role.coordinator) -> None:
        self._name = url.set(drivername="postgresql", query={}).render_as_string(hide_password=True)
        self._token = secrets.token_hex(8)
        """Identifies the announcements of this process."""
        self._role = role
        self._durable = durable
        arguments = {name: value for name, value in _CONNECT.items() if name not in url.query}
        # 24 readers, 4 touchers, a writer: three coordinators fit into the 100 connections of a
        # server by default.
        reader = create_engine(
            url, paramstyle="format", connect_args=arguments, pool_size=8, max_overflow=16
        )
        writer = create_engine(
            url, paramstyle="format", connect_args=arguments, pool_size=1, max_overflow=0
        )
        pool = {"pool_size": 4, "max_overflow": 0, "isolation_level": "AUTOCOMMIT"}
        self._toucher = create_engine(url, paramstyle="format", connect_args=arguments, **pool)
        self._arguments: dict[str, Any] = {
            **writer.dialect.create_connect_args(url)[1],
            **arguments,
        }
        for engine in (reader, writer, self._toucher):
            event.listen(
                engine,
                "connect",
                lambda connection, _: connection.adapters.register_dumper(str, _TextDumper),
            )
        event.listen(reader, "connect", _prepare_reader)
        event.listen(writer, "connect", self._prepare_writer)
        event.listen(writer, "close", _leave)
        event.listen(self._toucher, "connect", _prepare_toucher)
        super().__init__(reader, writer, self._toucher)

    @contextmanager
    def write(self) -> Iterator[Connection]:
        with super().write() as connection:
            _, _, now = connection.exec_driver_sql(_BEGIN, (self._token,)).one()
            # Leases are granted, renewed and taken back in writes: all coordinators do it by the
            # same clock.
            self._ahead = now - time.monotonic()
            yield connection

    def write_relaxed(self) -> AbstractContextManager[Connection]:
        """Connect beside writers; each statement is a transaction.

        A crash of the server may lose it.
        """
        return self._toucher.begin()

    def analyse(self) -> None:
        """Tell the server the sizes of the tables, which it would learn a minute later.

        Until then its plans are plans for empty tables.
        """
        with self._toucher.connect() as connection:
            connection.exec_driver_sql(
                "ANALYZE tasks, job_tasks, ready_tasks, task_dependencies, samples"
            )

    def is_alone(self, connection: Connection) -> bool:
        return not connection.exec_driver_sql(_COUNT_OTHER_USERS).scalar_one()

    async def listen(self, notify: Callable[[], None]) -> None:
        while True:
            try:
                connection = await psycopg.AsyncConnection.connect(
                    **self._arguments, autocommit=True
                )
                async with connection:
                    await connection.execute(f"LISTEN {_CHANNEL}")
                    notify()  # for writes before this connection listened
                    async for notice in connection.notifies():
                        if notice.payload != self._token:
                            notify()
            except psycopg.Error as error:
                logger.warning("no news of other coordinators from %s: %s", self._name, error)
                await asyncio.sleep(1.0)

    def _prepare_writer(self, connection: Driver, _record: ConnectionPoolEntry) -> None:
        for setting in _WRITER_SETTINGS:
            connection.execute(f"SET {setting}")
        if not self._durable:
            connection.execute("SET synchronous_commit = off")
        row = connection.execute(_ENTER[self._role]).fetchone()
        connection.commit()
        if row is None or not row[0]:
            raise DatabaseRefusedError(_REFUSALS[self._role].format(self._name))


def _leave(connection: Driver, _record: ConnectionPoolEntry) -> None:
    """Release the locks at once: the server ends a session some time after its connection."""
    with suppress(psycopg.Error):
        connection.execute("SELECT pg_advisory_unlock_all()")


def _prepare_reader(connection: Driver, _record: ConnectionPoolEntry) -> None:
    connection.isolation_level = psycopg.IsolationLevel.REPEATABLE_READ
    connection.read_only = True


def _prepare_toucher(connection: Driver, _record: ConnectionPoolEntry) -> None:
    connection.execute("SET synchronous_commit = off")
    connection.commit()


class _TextDumper(StrDumper):
    """Replaces the character 0, which messages may contain, and PostgreSQL cannot store."""

    def dump(self, obj: str) -> Buffer | None:
        return super().dump(obj.replace("\0", "\N{REPLACEMENT CHARACTER}"))
