"""The principal of a request, and the rows that it may see.

Every query for something that belongs to a project has one of the conditions `is_visible_...`. A
principal does not find the rows of another project: they are answered like missing ones. The
coordinator itself, the commands on its machine and keys of the scope `admin` see everything.

Requests without a key belong to the project with the empty name.
"""

import getpass
import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from enum import StrEnum

from sqlalchemy import ColumnElement, exists, or_, true

from stickslip_services.database.tables import dataset_versions, job_tasks, jobs
from stickslip_services.errors import CommandError, NotFoundError

NOBODY = "no key"
"""Name of the principal of a request without a key: anybody on this machine."""

_PROJECT = re.compile(r"([a-z0-9][a-z0-9-]{0,62})?")


class Scope(StrEnum):
    """The permission of a key: `submit` includes `read`, and `admin` includes everything."""

    read = "read"
    """Read the jobs, datasets and pages of the project of the key."""
    submit = "submit"
    """Submit jobs, and pause, resume, cancel and prioritise them."""
    work = "work"
    """Be a worker: register, lease tasks and report results."""
    admin = "admin"
    """Everything of all projects, and register certificates."""


@dataclass(frozen=True, slots=True)
class Principal:
    """A key, a request without one, a command on this machine, or the coordinator itself."""

    name: str = NOBODY
    """The id and the name of a key, `no key`, or `user NAME`."""
    scopes: frozenset[Scope] = frozenset(Scope)
    project: str = ""

    def may(self, needed: Scope) -> bool:
        """Return whether the scopes of the principal include a needed one."""
        if self.scopes & {needed, Scope.admin}:
            return True
        return needed is Scope.read and Scope.submit in self.scopes

    @property
    def sees_all(self) -> bool:
        """Whether the principal sees the rows of all projects."""
        return Scope.admin in self.scopes


# Code that runs outside of a request, for example a background service, acts for the coordinator.
_COORDINATOR = Principal()
_principal = ContextVar("principal", default=_COORDINATOR)


@contextmanager
def acting_as(principal: Principal) -> Iterator[None]:
    """Set the principal of a block, also in the threads that the block waits for."""
    token = _principal.set(principal)
    try:
        yield
    finally:
        _principal.reset(token)


def current_principal() -> Principal:
    """Return the principal for which the calling code acts."""
    return _principal.get()


def local_user() -> Principal:
    """Return the principal of a command on this machine."""
    try:
        return Principal(f"user {getpass.getuser()}")
    except (KeyError, OSError):  # a container's user may have no name
        return Principal("user without a name")


def check_project(name: str) -> str:
    """Return the name of a project; raise CommandError if it is malformed."""
    if _PROJECT.fullmatch(name) is None:
        raise CommandError(
            f"project must be lower-case letters, digits and '-', 63 at most; got {name[:100]!r}"
        )
    return name


def is_visible_project(project: ColumnElement[str]) -> ColumnElement[bool]:
    """Return the condition that the principal sees the rows of a project."""
    principal = current_principal()
    return true() if principal.sees_all else project == principal.project


def is_visible_task(task: ColumnElement[int]) -> ColumnElement[bool]:
    """Return the condition that a job that the principal sees has a task.

    Projects share tasks of the same content, so a task has no project of its own.
    """
    if current_principal().sees_all:
        return true()
    return exists().where(
        job_tasks.c.task == task,
        job_tasks.c.job == jobs.c.seq,
        is_visible_project(jobs.c.project),
    )


def is_visible_version() -> ColumnElement[bool]:
    """Return the condition that the principal sees a dataset version.

    It sees a version if one of its jobs made the version, or would make the same one. A version
    without a job belongs to the project with the empty name.
    """
    principal = current_principal()
    if principal.sees_all:
        return true()
    # Jobs that specify the same samples have the same publish task.
    has_made = jobs.c.publish_task == dataset_versions.c.publish_task
    has_job = exists().where(has_made, is_visible_project(jobs.c.project))
    if principal.project:
        return has_job
    # `stickslip reindex` registers versions of a store whose jobs are unknown. No project may
    # claim them, so only requests without a project find them.
    is_orphan = ~exists().where(has_made)
    return or_(has_job, is_orphan)


def refuse_projects(subject: str) -> None:
    """Raise NotFoundError if the principal belongs to a project.

    For answers about all projects, for example metrics.
    """
    principal = current_principal()
    if principal.project and not principal.sees_all:
        raise NotFoundError(f"{subject} are of all projects: ask with a key without a project")
