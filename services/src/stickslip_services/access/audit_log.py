"""The audit log: who changed what, and when. Append-only: the database refuses to change or delete an entry.

An entry is written in the transaction of the change itself, so that neither exists without the other.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from typing import Any

from sqlalchemy import Connection, insert, select
from stickslip_schemas.base import Document

from stickslip_services.access.asker import asking, this_asker, this_user
from stickslip_services.database.database import Role
from stickslip_services.database.opening import opened
from stickslip_services.database.paging import document_of
from stickslip_services.database.tables import audit_log
from stickslip_services.settings import Settings


class Entry(Document):
    """An entry of the audit log."""

    at: datetime
    actor: str
    """Name of the asker."""
    action: str
    """What was done, for example `job.cancel`."""
    subject: str
    """The id of the job, version, key, webhook or certificate that was changed."""
    details: dict[str, Any]


def note(connection: Connection, action: str, subject: str, now: float, **details: Any) -> None:
    connection.execute(
        insert(audit_log).values(
            at=now, actor=this_asker().name, action=action, subject=subject, details=json.dumps(details)
        )
    )


def read_audit_log(connection: Connection, *, subject: str | None = None, limit: int = 100) -> list[Entry]:
    """Return the last `limit` entries, newest first; with `subject`, only those about it."""
    query = select(audit_log).order_by(audit_log.c.seq.desc()).limit(limit)
    if subject is not None:
        query = query.where(audit_log.c.subject == subject)
    return [document_of(Entry, row, details=json.loads(row.details)) for row in connection.execute(query)]


@contextmanager
def visited(settings: Settings) -> Iterator[Connection]:
    """Open a write transaction on a database for a command on this machine; raise DatabaseRefusedError.

    A coordinator may run meanwhile.
    """
    with asking(this_user()), opened(settings, Role.visitor) as database, database.write() as connection:
        yield connection
