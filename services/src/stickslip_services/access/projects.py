"""Projects: the users that share a coordinator. A key belongs to one project, and so do the jobs submitted with it.

Leases are shared evenly between projects, and a project may have a quota. Requests without a key belong to the project
with the empty name.
"""

from dataclasses import dataclass

from sqlalchemy import Connection, delete, func, insert, select
from stickslip_schemas.base import JobState

from stickslip_services.access.asker import check_project
from stickslip_services.access.audit_log import note
from stickslip_services.database.tables import api_keys, jobs, projects
from stickslip_services.errors import QuotaExceededError

_OPEN = [state for state in JobState if state.is_open]


@dataclass(frozen=True, slots=True)
class Project:
    """A project with its quota and its usage."""

    name: str
    max_samples: int | None
    """Samples of jobs that have not ended; None: any number."""
    max_jobs: int | None
    """Jobs that have not ended; None: any number."""
    samples: int
    jobs: int


def set_quota(connection: Connection, name: str, *, max_samples: int | None, max_jobs: int | None, now: float) -> None:
    """Set the quota of a project from the next submission on; raise CommandError for a bad name."""
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
        raise QuotaExceededError(name, "samples", project.max_samples, taken=project.samples, asked=sample_count)
