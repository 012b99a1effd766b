"""Who asks, what they may do and see, and what they have done: scopes, API keys, projects and the
audit log.

Every query for something that belongs to a project has one of the conditions `own_...`. What
belongs to another project is thus not found. The coordinator itself, and commands on its machine,
see everything, and so do keys of the scope `admin`.

The database stores only the SHA-256 digests of the keys' secrets, which have 256 random bits and so
need no salt. A key belongs to one project, and so do the jobs submitted with it. Leases are shared
evenly between projects, and a project may have a quota. Requests without a key belong to the
project with the empty name.

The audit log is append-only: the database refuses to change or delete an entry. An entry is written
in the transaction of the change itself, so that neither exists without the other.
"""

import getpass
import json
import re
import secrets
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

from cryptography.fernet import Fernet
from sqlalchemy import (
    ColumnElement,
    Connection,
    Row,
    delete,
    exists,
    func,
    insert,
    or_,
    select,
    true,
    update,
)
from stickslip_schemas.base import Document, JobState, sha256
from stickslip_schemas.store import write_durably

from stickslip_services.database.database import Database, Role, document_of
from stickslip_services.database.opening import opened
from stickslip_services.database.tables import (
    api_keys,
    audit_log,
    dataset_versions,
    job_tasks,
    jobs,
    projects,
)
from stickslip_services.errors import CommandError, NotFoundError, QuotaExceededError, SettingsError
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
        raise CommandError(
            f"project must be lower-case letters, digits and '-', 63 at most; got {name[:100]!r}"
        )
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
        return bool(self.scopes & {needed, Scope.admin}) or (
            needed is Scope.read and Scope.submit in self.scopes
        )

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
    """Return the condition that a job that the asker sees has a task.

    Projects share tasks of one content.
    """
    if this_asker().sees_all:
        return true()
    return exists().where(
        job_tasks.c.task == task, job_tasks.c.job == jobs.c.seq, own(jobs.c.project)
    )


def own_version() -> ColumnElement[bool]:
    """Return the condition that a job that the asker sees has made a dataset version, or would make
    the same one.

    A version without a job belongs to the project with the empty name.
    """
    asker = this_asker()
    if asker.sees_all:
        return true()
    made = jobs.c.publish_task == dataset_versions.c.publish_task
    is_own = exists().where(made, own(jobs.c.project))
    return is_own if asker.project else or_(is_own, ~exists().where(made))


def refuse_projects(what: str) -> None:
    """Raise NotFoundError where the asker belongs to a project, for something that tells about all
    of them.
    """
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
            at=now,
            actor=this_asker().name,
            action=action,
            subject=subject,
            details=json.dumps(details),
        )
    )


def read_audit_log(
    connection: Connection, *, subject: str | None = None, limit: int = 100
) -> list[Entry]:
    """Return the last `limit` entries, newest first; with `subject`, only those about it."""
    query = select(audit_log).order_by(audit_log.c.seq.desc()).limit(limit)
    if subject is not None:
        query = query.where(audit_log.c.subject == subject)
    return [
        document_of(Entry, row, details=json.loads(row.details))
        for row in connection.execute(query)
    ]


@contextmanager
def visited(settings: Settings) -> Iterator[Connection]:
    """Open a write transaction on a database for a command on this machine.

    Raise DatabaseRefusedError.

    A coordinator may run meanwhile.
    """
    with (
        asking(this_user()),
        opened(settings, Role.visitor) as database,
        database.write() as connection,
    ):
        yield connection


LOCAL_WORKER = "local-worker"
"""Name of the key in the file `worker-key` of the data directory."""

FRESH_SECONDS = 1.0
"""Delay until a new or revoked key takes effect, at most [s]."""


def create_key(
    connection: Connection, name: str, scopes: Collection[Scope], now: float, *, project: str = ""
) -> tuple[str, str]:
    """Make a key; return its id and its secret, which is not stored.

    Raise CommandError for a bad name or project.
    """
    if not 1 <= len(name) <= 100:
        raise CommandError(f"name must have 1 to 100 characters, and has {len(name)}")
    secret = f"sk_{secrets.token_urlsafe(32)}"
    key_id = _insert(connection, name, scopes, secret, now, project=check_project(project))
    told = [scope for scope in Scope if scope in scopes]
    note(connection, "key.create", key_id, now, name=name, scopes=told, project=project)
    return key_id, secret


def list_keys(connection: Connection) -> Sequence[Row[Any]]:
    """Return the rows of all keys, also the revoked ones, newest first."""
    return connection.execute(select(api_keys).order_by(api_keys.c.seq.desc())).all()


def revoke_key(connection: Connection, key_id: str, now: float) -> None:
    """Revoke a key; raise NotFoundError."""
    revoked = update(api_keys).values(revoked_at=func.coalesce(api_keys.c.revoked_at, now))
    if connection.execute(revoked.where(api_keys.c.id == key_id)).rowcount == 0:
        raise NotFoundError(f"there is no key {key_id[:100]!r}")
    note(connection, "key.revoke", key_id, now)


def secret_in(path: Path) -> str:
    """Return the secret in a key file.

    Make the file where it is missing, readable by its owner alone.
    """
    if not path.exists():
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_durably(path, f"{secrets.token_urlsafe(32)}\n".encode(), mode=0o600)
    return path.read_text(encoding="ascii").strip()


def sealer(settings: Settings) -> Fernet:
    """Return the cipher of secrets that the database keeps sealed.

    Raise SettingsError for a key of another form.
    """
    given = settings.secrets_key
    key = secret_in(settings.data / "secrets-key") if given is None else given.get_secret_value()
    try:
        return Fernet(key.rstrip("=") + "=")
    except ValueError:
        raise SettingsError(
            "the secrets key must be 32 bytes in base64, as `openssl rand -base64 32` makes"
        ) from None


def admit_local_worker(connection: Connection, path: Path, now: float) -> None:
    """Register the secret of the local workers as a key of the scope `work`; replace a revoked one."""
    digest = sha256(secret_in(path).encode())
    row = connection.execute(
        select(api_keys.c.revoked_at).where(api_keys.c.digest == digest)
    ).one_or_none()
    if row is not None and row.revoked_at is not None:
        path.unlink()
        row = None
    if row is None:
        _insert(connection, LOCAL_WORKER, (Scope.work,), secret_in(path), now)


class KeyRing:
    """Cache of the valid keys. Thread-safe."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._holders: dict[str, Asker] = {}
        self._read_at = float("-inf")

    @property
    def is_fresh(self) -> bool:
        """True where `holder_of` does not need the database."""
        return time.monotonic() < self._read_at + FRESH_SECONDS

    def holder_of(self, secret: str) -> Asker | None:
        """Return the holder of a secret; None if it is unknown or revoked."""
        with self._lock:
            if not self.is_fresh:
                with self._database.read() as connection:
                    rows = connection.execute(
                        select(api_keys).where(api_keys.c.revoked_at.is_(None))
                    )
                    self._holders = {
                        row.digest: Asker(
                            f"{row.id} {row.name}",
                            frozenset(map(Scope, row.scopes.split())),
                            row.project,
                        )
                        for row in rows
                    }
                self._read_at = time.monotonic()
            return self._holders.get(sha256(secret.encode()))


def _insert(
    connection: Connection,
    name: str,
    scopes: Collection[Scope],
    secret: str,
    now: float,
    *,
    project: str = "",
) -> str:
    key_id = f"key-{secrets.token_hex(8)}"
    connection.execute(
        insert(api_keys).values(
            id=key_id,
            name=name,
            digest=sha256(secret.encode()),
            scopes=" ".join(scope for scope in Scope if scope in scopes),
            project=project,
            created_at=now,
        )
    )
    return key_id


_OPEN = [state for state in JobState if state.is_open]


@dataclass(frozen=True, slots=True)
class Project:
    name: str
    max_samples: int | None
    """Samples of jobs that have not ended; None: any number."""
    max_jobs: int | None
    """Jobs that have not ended; None: any number."""
    samples: int
    jobs: int


def set_quota(
    connection: Connection, name: str, *, max_samples: int | None, max_jobs: int | None, now: float
) -> None:
    """Set the quota of a project from the next submission on; raise CommandError for a bad name."""
    connection.execute(delete(projects).where(projects.c.name == check_project(name)))
    connection.execute(
        insert(projects).values(name=name, max_samples=max_samples, max_jobs=max_jobs)
    )
    note(connection, "project.quota", name, now, max_samples=max_samples, max_jobs=max_jobs)


def list_projects(connection: Connection) -> list[Project]:
    """Return the projects that have a quota, a key or a job, by name."""
    names = {
        *connection.scalars(select(projects.c.name)),
        *connection.scalars(select(api_keys.c.project).distinct()),
        *connection.scalars(select(jobs.c.project).distinct()),
    }
    return [find_project(connection, name) for name in sorted(names)]


def find_project(connection: Connection, name: str) -> Project:
    """Return a project; an unknown one has no quota and no jobs."""
    limits = connection.execute(
        select(projects.c.max_samples, projects.c.max_jobs).where(projects.c.name == name)
    ).one_or_none()
    taken = connection.execute(
        select(func.coalesce(func.sum(jobs.c.sample_count), 0), func.count()).where(
            jobs.c.project == name, jobs.c.state.in_(_OPEN)
        )
    ).one()
    most = (None, None) if limits is None else tuple(limits)
    return Project(name, most[0], most[1], int(taken[0]), int(taken[1]))


def check_quota(connection: Connection, name: str, sample_count: int) -> None:
    """Raise QuotaExceededError where one more job of `sample_count` samples exceeds the quota."""
    project = find_project(connection, name)
    if project.max_jobs is not None and project.jobs + 1 > project.max_jobs:
        raise QuotaExceededError(name, "jobs", project.max_jobs, taken=project.jobs, asked=1)
    if project.max_samples is not None and project.samples + sample_count > project.max_samples:
        raise QuotaExceededError(
            name, "samples", project.max_samples, taken=project.samples, asked=sample_count
        )
