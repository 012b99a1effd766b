"""Projects and their quotas: how many jobs and samples a project may have in flight."""

from dataclasses import dataclass

from sqlalchemy import Connection, delete, func, insert, select
from stickslip_schemas.base import JobState

from stickslip_services.access import audit_log
from stickslip_services.access.principals import check_project
from stickslip_services.database.tables import api_keys, jobs, projects
from stickslip_services.errors import QuotaExceededError

_OPEN = [state for state in JobState if state.is_open]


@dataclass(frozen=True, slots=True)
class Project:
    """A project: its quota, and its jobs that have not ended."""

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
    # A quota of None for both is that of a project that has no row.
    connection.execute(delete(projects).where(projects.c.name == check_project(name)))
    connection.execute(
        insert(projects).values(name=name, max_samples=max_samples, max_jobs=max_jobs)
    )
    audit_log.append(
        connection, "project.quota", name, now, max_samples=max_samples, max_jobs=max_jobs
    )


def list_projects(connection: Connection) -> list[Project]:
    """Return the projects that have a quota, a key or a job, by name."""
    # A project needs no entry of its own: its keys and jobs name it.
    names = {
        *connection.scalars(select(projects.c.name)),
        *connection.scalars(select(api_keys.c.project).distinct()),
        *connection.scalars(select(jobs.c.project).distinct()),
    }
    return [find_project(connection, name) for name in sorted(names)]


def find_project(connection: Connection, name: str) -> Project:
    """Return a project; an unknown one has no quota and no jobs."""
    quota = connection.execute(
        select(projects.c.max_samples, projects.c.max_jobs).where(projects.c.name == name)
    ).one_or_none()
    in_flight = connection.execute(
        select(func.coalesce(func.sum(jobs.c.sample_count), 0), func.count()).where(
            jobs.c.project == name, jobs.c.state.in_(_OPEN)
        )
    ).one()
    return Project(
        name,
        max_samples=None if quota is None else quota.max_samples,
        max_jobs=None if quota is None else quota.max_jobs,
        samples=int(in_flight[0]),
        jobs=int(in_flight[1]),
    )


def check_quota(connection: Connection, name: str, sample_count: int) -> None:
    """Raise QuotaExceededError if one more job of `sample_count` samples exceeds the quota."""
    project = find_project(connection, name)
    if project.max_jobs is not None and project.jobs + 1 > project.max_jobs:
        raise QuotaExceededError(name, "jobs", project.max_jobs, used=project.jobs, requested=1)
    if project.max_samples is not None and project.samples + sample_count > project.max_samples:
        raise QuotaExceededError(
            name, "samples", project.max_samples, used=project.samples, requested=sample_count
        )
