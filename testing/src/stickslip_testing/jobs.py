"""Small specs, a clock that only tests move, and the jobs and datasets of a coordinator."""

from typing import Any

from stickslip_schemas.documents.responses import Dataset, Job, JobDetail
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_services.catalog import versions
from stickslip_services.database.database import PageRequest
from stickslip_services.queue import jobs
from stickslip_services.queue.context import Context
from stickslip_services.queue.jobs import find_job


class ManualClock:
    """A clock that stands still until it is set."""

    def __init__(self) -> None:
        self.now = 1_800_000_000.0

    def __call__(self) -> float:
        return self.now

    def advance(self, seconds: float) -> None:
        """Move the clock forward [s]."""
        self.now += seconds


def rods(gamma: Any = (1.0, 2.0), phi1: Any = (1.0, 3.0), **rest: Any) -> dict[str, Any]:
    """Return the document of a small spec of rods, with other fields from `rest`."""
    gamma = list(gamma) if isinstance(gamma, tuple) else gamma
    axes = {"gamma": gamma, "phi0": 0.0, "phi1": list(phi1) if isinstance(phi1, tuple) else phi1}
    return {"kind": "rod_hang", "axes": axes, "samples_per_shard": 2, **rest}


def parsed(spec: dict[str, Any]) -> Any:
    """Return a spec as the coordinator parses it."""
    return job_spec_adapter.validate_python(spec)


def show_job(context: Context, job_id: str) -> JobDetail:
    """Return a job."""
    with context.database.read() as connection:
        return jobs.show_job(context, connection, find_job(connection, job_id).seq)


def list_jobs(context: Context) -> tuple[Job, ...]:
    """Return all jobs, newest first."""
    with context.database.read() as connection:
        return jobs.list_jobs(context, connection, PageRequest(1000, None)).items


def list_datasets(context: Context) -> tuple[Dataset, ...]:
    """Return all datasets, newest first."""
    with context.database.read() as connection:
        return versions.list_datasets(connection, PageRequest(1000, None)).items
