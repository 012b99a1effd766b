"""Who asks, and what they may do and see: the one place that answers for a scope and a project; and the audit log.

Every query for something that belongs to a project has one of the conditions `own_...`. What belongs to another project
is thus not found. The coordinator itself, and commands on its machine, see everything, and so do keys of the scope
`admin`.

The audit log says who changed what, and when. It is append-only: the database refuses to change or delete an entry. An
entry is written in the transaction of the change itself, so that neither exists without the other.
"""

import getpass
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any

from sqlalchemy import ColumnElement, Connection, exists, insert, or_, select, true
from stickslip_schemas.base import Document

from stickslip_services.database.database import Role, document_of
from stickslip_services.database.opening import opened
from stickslip_services.database.tables import audit_log, dataset_versions, job_tasks, jobs
from stickslip_services.errors import CommandError, NotFoundError
from stickslip_services.settings import Settings


class Scope(StrEnum):
    """What a key permits. `submit` includes `read`; `admin` includes everything."""

    read = "read"
    """Read what belongs to the project of the key: jobs, datasets, pages."""
    submit = "submit"
    """Submit jobs, and pause, resume, cancel and prioritise them."""
    work = "work"
    """Be a worker: register, lease tasks and report results."""
    admin = "admin"
    """Everything of all projects, and register certificates."""


def check_project(name: str) -> str:
    """Return the name of a project; raise CommandError where it is malformed."""
    if re.fullmatch(r"([a-z0-9][a-z0-9-]{0,62})?", name) is None:
        raise CommandError(f"project must be lower-case letters, digits and '-', 63 at most; got {name[:100]!r}")
    return name


NOBODY = "no key"
"""Name of who asks without a key: anybody on this machine."""


@dataclass(frozen=True, slots=True)
class Asker:
    """A key, a request without one, a command on this machine, or the coordinator itself."""

    name: str = NOBODY
    """The id and the name of a key, `no key`, or `user NAME`."""
    scopes: frozenset[Scope] = frozenset(Scope)
    project: str = ""

    def may(self, needed: Scope) -> bool:
        return bool(self.scopes & {needed, Scope.admin}) or (needed is Scope.read and Scope.submit in self.scopes)

    @property
    def sees_all(self) -> bool:
        return Scope.admin in self.scopes


_EVERYTHING = Asker()
_asker = ContextVar("asker", default=_EVERYTHING)


@contextmanager
def asking(asker: Asker) -> Iterator[None]:
    """Set who asks in the block, also in threads that it waits for."""
    token = _asker.set(asker)
    try:
        yield
    finally:
        _asker.reset(token)


def this_asker() -> Asker:
    return _asker.get()


def this_user() -> Asker:
    """Return the asker of a command on this machine."""
    try:
        return Asker(f"user {getpass.getuser()}")
    except (KeyError, OSError):  # a container's user may have no name
        return Asker("user without a name")


def own(project: ColumnElement[str]) -> ColumnElement[bool]:
    """Return the condition that a row of a project is one that the asker sees."""
    asker = this_asker()
    return true() if asker.sees_all else project == asker.project


def own_task(task: ColumnElement[int]) -> ColumnElement[bool]:
    """Return the condition that a job that the asker sees has a task. Projects share tasks of one content."""
    if this_asker().sees_all:
        return true()
    return exists().where(job_tasks.c.task == task, job_tasks.c.job == jobs.c.seq, own(jobs.c.project))


def own_version() -> ColumnElement[bool]:
    """Return the condition that a job that the asker sees has made a dataset version, or would make the same one.

    A version without a job belongs to the project with the empty name.
    """
    asker = this_asker()
    if asker.sees_all:
        return true()
    made = jobs.c.publish_task == dataset_versions.c.publish_task
    is_own = exists().where(made, own(jobs.c.project))
    return is_own if asker.project else or_(is_own, ~exists().where(made))


def refuse_projects(what: str) -> None:
    """Raise NotFoundError where the asker belongs to a project, for something that tells about all of them."""
    if this_asker().project and not this_asker().sees_all:
        raise NotFoundError(f"{what} are of all projects: ask with a key without a project")


class Entry(Document):
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
