"""The audit log: the author, the subject and the time of each change.

It is append-only: the database refuses to change or delete an entry. An entry is written in the
transaction of the change itself, so that neither exists without the other.
"""

import json
from datetime import datetime
from typing import Any

from sqlalchemy import Connection, bindparam, insert, select
from stickslip_schemas.base import Document

from stickslip_services.access.principals import current_principal
from stickslip_services.database import tables
from stickslip_services.database.database import document_of
from stickslip_services.database.statements import Statement


class Entry(Document):
    """An entry of the audit log."""

    at: datetime
    actor: str
    """Name of the principal."""
    action: str
    """The action, for example `job.cancel`."""
    subject: str
    """The id of the job, version, key, webhook or certificate that was changed."""
    details: dict[str, Any]


_APPEND = Statement(
    insert(tables.audit_log).values(
        {name: bindparam(name) for name in ("at", "actor", "action", "subject", "details")}
    )
)


def append(
    connection: Connection, action: str, subject: str, now: float, **details: object
) -> None:
    """Append an entry in the transaction of the change; `details` must be JSON."""
    row = {
        "at": now,
        "actor": current_principal().name,
        "action": action,
        "subject": subject,
        "details": json.dumps(details, allow_nan=False),
    }
    _APPEND.run(connection, row)


def read(connection: Connection, *, subject: str | None = None, limit: int = 100) -> list[Entry]:
    """Return the last `limit` entries, newest first; with `subject`, only its entries."""
    columns = tables.audit_log.c
    query = select(tables.audit_log).order_by(columns.seq.desc()).limit(limit)
    if subject is not None:
        query = query.where(columns.subject == subject)
    return [
        document_of(Entry, row, details=json.loads(row.details))
        for row in connection.execute(query)
    ]
