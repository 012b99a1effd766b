"""Projects: who shares a coordinator. A key belongs to one, and so do the jobs that are submitted with it.

Leases are shared evenly between projects, and a project may have a quota. Requests without a key belong to the project
without a name.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from sqlalchemy import Connection, delete, func, insert, select

from stickslip_services.database.tables import api_keys, jobs, projects
from stickslip_services.errors import QuotaExceededError
from stickslip_services.journal import note
from stickslip_services.queue.ledger import OPEN
from stickslip_services.scopes import check_project

_project = ContextVar("project", default="")


@dataclass(frozen=True, slots=True)
class Project:
    """A project with its quota and what of it is taken."""

    name: str
    max_samples: int | None
    """Samples of jobs that have not ended; None: any number."""
    max_jobs: int | None
    """Jobs that have not ended; None: any number."""
    samples: int
    jobs: int


@contextmanager
def acting_for(project: str) -> Iterator[None]:
    """Say for which project is done what is done in the block, also in the threads that it waits for."""
    token = _project.set(project)
    try:
        yield
    finally:
        _project.reset(token)


def this_project() -> str:
    """Return for which project something is done now."""
    return _project.get()


def set_quota(connection: Connection, name: str, *, max_samples: int | None, max_jobs: int | None, now: float) -> None:
    """Give a project another quota; it holds for the next submission. Raise ValueError for a name that is none."""
    connection.execute(delete(projects).where(projects.c.name == check_project(name)))
    connection.execute(insert(projects).values(name=name, max_samples=max_samples, max_jobs=max_jobs))
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
    """Return a project; one that nobody has named yet has no quota and no job."""
    limits = connection.execute(
        select(projects.c.max_samples, projects.c.max_jobs).where(projects.c.name == name)
    ).one_or_none()
    taken = connection.execute(
        select(func.coalesce(func.sum(jobs.c.sample_count), 0), func.count()).where(
            jobs.c.project == name, jobs.c.state.in_(OPEN)
        )
    ).one()
    most = (None, None) if limits is None else tuple(limits)
    return Project(name, most[0], most[1], int(taken[0]), int(taken[1]))


def check_quota(connection: Connection, name: str, sample_count: int) -> None:
    """Raise QuotaExceededError where one more job, with so many samples, is more than a project may have."""
    project = find_project(connection, name)
    if project.max_jobs is not None and project.jobs + 1 > project.max_jobs:
        raise QuotaExceededError(name, "jobs", project.max_jobs, taken=project.jobs, asked=1)
    if project.max_samples is not None and project.samples + sample_count > project.max_samples:
        raise QuotaExceededError(name, "samples", project.max_samples, taken=project.samples, asked=sample_count)
