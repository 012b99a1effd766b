"""A write transaction of the queue: its connection, and the time that all of its changes have."""

from dataclasses import dataclass

from sqlalchemy import Connection


@dataclass(frozen=True, slots=True)
class QueueTransaction:
    """The functions of the queue that change something take one."""

    connection: Connection
    now: float
    """Seconds since 1970, by the clock that all coordinators share [s]."""
