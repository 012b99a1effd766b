"""A write transaction of the queue, with one time for all of its changes."""

from dataclasses import dataclass

from sqlalchemy import Connection


@dataclass(frozen=True, slots=True)
class QueueTransaction:
    """A connection and a time, which every function that changes the queue takes."""

    connection: Connection
    now: float
    """Seconds since 1970, by the clock that all coordinators share [s]."""
