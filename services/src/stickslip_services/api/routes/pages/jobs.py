"""Pages of jobs, of workers, and of the HTTP interface.

A job has a page, a map of its grid, and buttons.
"""

import asyncio
import pathlib
from collections.abc import AsyncIterator
from typing import Annotated, Literal
from urllib.parse import urlencode

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, Field
from sqlalchemy import func, select
from stickslip_schemas.base import JobState, TaskState
from stickslip_schemas.documents.responses import JobDetail
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.costs import count, estimate_cost

from stickslip_services.addresses import link
from stickslip_services.api.routes.common import ContextDep
from stickslip_services.api.sse import KEEP_ALIVE_SECONDS, EventStream
from stickslip_services.catalog.inputs import list_certificates
from stickslip_services.database.database import PageRequest, as_datetime
from stickslip_services.database.tables import dataset_versions
from stickslip_services.errors import NotFoundError
from stickslip_services.pages.rendering import grid_maps, html_page, spec_text
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job, pause_job, resume_job, retry_task
from stickslip_services.queue.failures import failed_tasks
from stickslip_services.queue.jobs import (
    find_job,
    job_projects,
    list_jobs,
    list_previews,
    list_samples,
    lost_slots,
    show_job,
    slowest_tasks,
)
from stickslip_services.queue.progress import stage_durations
from stickslip_services.queue.submit import submit_job
from stickslip_services.queue.task_log import read_task_log
from stickslip_services.queue.workers import alive_workers, show_workers

router = APIRouter(include_in_schema=False)

SHOWN_JOBS = 50
SHOWN_LOST = 50
SHOWN_SLOWEST = 8
SHOWN_MAPS = 3
SHOWN_CERTIFICATES = 200

MAX_SAMPLES = 20_000
"""Larger grids have no map, because reading the states of so many samples takes seconds."""

MAY_RETRY = (TaskState.failed, TaskState.soft_failed)
"""States of a task that may run again."""

CHANGE_SECONDS = 1.0
"""Least time between two updates of a page [s]."""


class JobFilter(BaseModel):
    """What the form of the list asks for; all of it stands in the address of the page."""

    search: str = Field("", max_length=100)
    state: JobState | Literal[""] = ""
    project: str = Field("", max_length=100)
    order: Literal["newest", "oldest"] = "newest"
    after: int | None = Field(None, ge=0, lt=10**18)


FilterDep = Annotated[JobFilter, Query()]


@router.get("/")
def get_jobs(context: ContextDep, chosen: FilterDep) -> Response:
    """Show a page of the jobs that fit the form."""
    with context.database.read() as connection:
        page = list_jobs(
            context,
            connection,
            PageRequest(SHOWN_JOBS, chosen.after),
            chosen.search,
            chosen.state or None,
            chosen.project,
            newest_first=chosen.order == "newest",
        )
        workers, projects = len(alive_workers(context, connection)), job_projects(connection)
    query = chosen.model_dump(mode="json", exclude_defaults=True)
    return html_page(
        "jobs.html",
        here="jobs",
        jobs=page.items,
        more=page.next_page_token and urlencode(query | {"after": page.next_page_token}),
        workers=workers,
        projects=projects,
        chosen=chosen,
        query=query,
        states=JobState,
    )


@router.get("/jobs/{job_id}")
def get_job(job_id: str, context: ContextDep) -> Response:
    """Show a job: its progress, its spec, and its first rejected and failed samples."""
    with context.database.read() as connection:
        seq = int(find_job(connection, job_id).seq)
        job = show_job(context, connection, seq)
        end = context.clock() if job.finished_at is None else job.finished_at.timestamp()
        return html_page(
            "job.html",
            here="jobs",
            job=job,
            spec=spec_text(job.spec),
            durations=stage_durations(connection, seq),
            elapsed=None if job.started_at is None else end - job.started_at.timestamp(),
            accepted=job.sample_count - job.rejected_count,
            costs=estimate_cost(job.spec, count(job.spec), {}, 0),
            previews=list_previews(connection, seq, count=24, newest=True),
            rejected=list_samples(
                connection, seq, PageRequest(SHOWN_LOST, None), TaskState.rejected
            ).items,
            failed=failed_tasks(connection, seq, context.settings, SHOWN_LOST),
            states=JobState,
        )


@router.get("/jobs/{job_id}/tasks/{task_id}")
def get_task(job_id: str, task_id: str, context: ContextDep) -> Response:
    """Show a task of a job: its numbers, the log of its attempts, and how to run it again."""
    with context.database.read() as connection:
        seq = int(find_job(connection, job_id).seq)
        return html_page(
            "task.html",
            here="jobs",
            job=show_job(context, connection, seq),
            task=read_task_log(connection, seq, task_id, context.settings),
            may_retry=MAY_RETRY,
        )


@router.post("/ui/jobs/{job_id}/tasks/{task_id}/retry")
def retry_failed_task(job_id: str, task_id: str, context: ContextDep) -> Response:
    """Let a failed task of a job run again; redirect to its page."""
    retry_task(context, job_id, task_id)
    page = link(f"/jobs/{job_id}/tasks/{task_id}")
    return Response(status_code=204, headers={"HX-Redirect": page})


@router.get("/ui/jobs/{job_id}/map")
def get_job_map(job_id: str, context: ContextDep) -> Response:
    """Show maps of the grid of a job, with the outcomes of its samples."""
    with context.database.read() as connection:
        row = find_job(connection, job_id)
        spec = job_spec_adapter.validate_json(row.spec)
        if spec.sample_count > MAX_SAMPLES:
            return html_page("map.html", maps=None, count=spec.sample_count)
        samples = list_samples(connection, row.seq, PageRequest(MAX_SAMPLES, None), None).items
        lost_ones = lost_slots(connection, row.seq)
    if len(samples) < spec.sample_count:
        return html_page("map.html", maps=[], count=spec.sample_count)
    done = np.array([sample.state is TaskState.succeeded for sample in samples])
    lost = np.zeros(len(samples), dtype=bool)
    lost[lost_ones] = True
    maps = grid_maps(spec, done, lost, most=SHOWN_MAPS)
    return html_page("map.html", maps=maps, count=spec.sample_count)


@router.get("/ui/jobs/{job_id}/slowest")
def get_slowest(job_id: str, context: ContextDep) -> Response:
    """Show the tasks of a job that took longest."""
    with context.database.read() as connection:
        slowest = slowest_tasks(connection, int(find_job(connection, job_id).seq), SHOWN_SLOWEST)
    return html_page("slowest.html", slowest=slowest, job_id=job_id)


@router.post("/ui/jobs/{job_id}/{verb}")
def change_job(job_id: str, verb: str, context: ContextDep) -> Response:
    """Pause, resume or cancel a job, or submit its spec again; redirect to the job."""
    if verb == "resubmit":
        with context.database.read() as connection:
            spec = job_spec_adapter.validate_json(find_job(connection, job_id).spec)
        job = submit_job(context, spec)
        assert isinstance(job, JobDetail)  # without an idempotency key there is no replay
        job_id = job.id
    elif verb in ("pause", "resume", "cancel"):
        {"pause": pause_job, "resume": resume_job, "cancel": cancel_job}[verb](context, job_id)
    else:
        raise NotFoundError(f"a job has no verb {verb[:50]!r}")
    return Response(status_code=204, headers={"HX-Redirect": link(f"/jobs/{job_id}")})


@router.get("/ui/changes")
def get_changes(context: ContextDep) -> EventStream:
    """Send an event to a page after each change of the database, without reading it.

    At most once a second.
    """
    headers = {"Cache-Control": "no-store"}
    return EventStream(_changes(context), headers=headers, media_type="text/event-stream")


async def _changes(context: Context) -> AsyncIterator[bytes]:
    yield b"retry: 2000\n\n"
    # The first event comes at once: the database may have changed since the page was rendered.
    sent = -1
    while True:
        await context.notifier.wait(sent, KEEP_ALIVE_SECONDS)
        count = context.notifier.count
        yield b": still here\n\n" if count == sent else b"event: change\ndata: {}\n\n"
        sent = count
        await asyncio.sleep(CHANGE_SECONDS)


@router.get("/workers")
def get_workers(context: ContextDep) -> Response:
    """Show the workers with their builds, the disk of the store, and the memory of this machine."""
    with context.database.read() as connection:
        workers = show_workers(context, connection)
        certified = {
            entry.sim_core: entry
            for entry in reversed(
                list_certificates(connection, PageRequest(SHOWN_CERTIFICATES, None)).items
            )
            if entry.extent == "full" and entry.passed
        }
        columns = dataset_versions.c
        read_at, damaged = connection.execute(
            select(func.min(columns.scrubbed_at), func.sum(columns.damaged))
        ).one()
    return html_page(
        "workers.html",
        here="workers",
        workers=workers,
        certified=certified,
        scrub=None if read_at is None else (as_datetime(read_at), int(damaged)),
        now=as_datetime(context.clock()),
        disk=context.store.disk_usage(),
        memory=_memory(),
    )


def _memory() -> dict[str, int] | None:
    """Return the memory of this machine, `MemTotal` and `MemAvailable` [B].

    None without Linux's /proc.
    """
    try:
        lines = [line.split() for line in pathlib.Path("/proc/meminfo").read_text().splitlines()]
    except OSError:
        return None
    sizes = {line[0].rstrip(":"): 1024 * int(line[1]) for line in lines}
    return sizes if {"MemTotal", "MemAvailable"} <= sizes.keys() else None


@router.get("/docs")
def get_docs(request: Request) -> Response:
    """Show the operations of the API."""
    return html_page("docs.html", here="docs", api=request.app.openapi())
