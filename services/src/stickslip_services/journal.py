"""The journal: who changed what, and when. It can only be added to; the database itself refuses anything else.

A line is written in the transaction of the change that it tells of, so neither is there without the other.
"""

import getpass
import json
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Connection, insert, select

from stickslip_services.clock import as_datetime
from stickslip_services.database.tables import journal

NOBODY = "no key"
"""Who sends a request that needs no key: anybody on this machine."""

_actor = ContextVar("actor", default=NOBODY)


@dataclass(frozen=True, slots=True)
class Line:
    """A line of the journal."""

    at: datetime
    actor: str
    """The id and the name of a key, `no key`, or `user NAME` of a command on the machine of the data."""
    action: str
    """What was done, as `job.cancel`."""
    subject: str
    """To what: the id of a job, a version, a key, a webhook or a certificate."""
    details: dict[str, Any]


@contextmanager
def acting(name: str) -> Iterator[None]:
    """Say who does what is done in the block, also in the threads that it waits for."""
    token = _actor.set(name)
    try:
        yield
    finally:
        _actor.reset(token)


def this_user() -> str:
    """Return who runs a command on this machine."""
    try:
        return f"user {getpass.getuser()}"
    except (KeyError, OSError):  # a container's user may have no name
        return "user without a name"


def note(connection: Connection, action: str, subject: str, now: float, **details: Any) -> None:
    """Write a line."""
    connection.execute(
        insert(journal).values(at=now, actor=_actor.get(), action=action, subject=subject, details=json.dumps(details))
    )


def read_journal(connection: Connection, *, subject: str | None = None, limit: int = 100) -> list[Line]:
    """Return the last lines, newest first; with `subject`, only those about it."""
    query = select(journal).order_by(journal.c.seq.desc()).limit(limit)
    if subject is not None:
        query = query.where(journal.c.subject == subject)
    return [
        Line(as_datetime(row.at), row.actor, row.action, row.subject, json.loads(row.details))
        for row in connection.execute(query)
    ]
