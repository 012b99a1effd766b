"""Routes of jobs: submit, list, watch, pause, resume and cancel them."""

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from stickslip_schemas.base import JobState, TaskState
from stickslip_schemas.documents.responses import (
    Job,
    JobDetail,
    JobPatch,
    Page,
    Preview,
    SampleState,
    Validation,
)
from stickslip_schemas.kinds import AnyJobSpec
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.addresses import link
from stickslip_services.api.bodies import SMALL_BYTES, SPEC_BYTES, JsonBody
from stickslip_services.api.problems import EVENT_ID_PATTERN
from stickslip_services.api.routes.common import (
    ContextDep,
    PageDep,
    Responses,
    StrictRoute,
    problem_responses,
    reads,
)
from stickslip_services.api.sse import OPENAPI as STREAM
from stickslip_services.api.sse import Feeds
from stickslip_services.queue import control
from stickslip_services.queue.estimate import validate_spec
from stickslip_services.queue.jobs import find_job, list_jobs, list_previews, list_samples, show_job
from stickslip_services.queue.submit import Replay, submit_job

router = APIRouter(route_class=StrictRoute)

SpecBody = Annotated[JobSpec, Depends(JsonBody(AnyJobSpec, max_bytes=SPEC_BYTES))]

_LOCATION = {"Location": {"description": "The job", "schema": {"type": "string"}}}
_CHANGED: Responses = {
    202: {"description": "The job after the change"},
    **problem_responses(404, 409),
}
_REPLAYED: dict[str, Any] = {
    "description": "The answer that this Idempotency-Key got the first time",
    "model": JobDetail,
    "headers": _LOCATION,
}


@router.post(
    "/v1/jobs",
    status_code=202,
    response_model=JobDetail,
    **reads(
        "JobSpec",
        *(409, 429),
        answers={
            200: _REPLAYED,
            202: {"description": "The job is in the queue", "headers": _LOCATION},
        },
    ),
)
def post_job(
    spec: SpecBody,
    context: ContextDep,
    idempotency_key: Annotated[
        str | None,
        Header(
            min_length=1,
            max_length=255,
            description=(
                "idempotency key: repeated requests with the same key make one job. Kept forever."
            ),
        ),
    ] = None,
    priority: Annotated[
        int,
        Query(ge=-100, le=100, description="tasks of the job with the highest number come first"),
    ] = 0,
) -> Response:
    """Submit a job. Existing results are reused, and failed tasks are tried again.

    429: the project of the key has reached its quota of jobs or samples.
    """
    job = submit_job(context, spec, idempotency_key, priority=priority)
    if isinstance(job, Replay):
        return Response(
            job.response, 200, {"Location": link(f"/v1/jobs/{job.job_id}")}, "application/json"
        )
    return Response(
        job.model_dump_json(), 202, {"Location": link(f"/v1/jobs/{job.id}")}, "application/json"
    )


@router.post("/v1/jobs:validate", **reads("JobSpec"))
def validate_job(spec: SpecBody, context: ContextDep) -> Validation:
    """Return counts and sizes of a job, and why it would be refused, without making it."""
    return validate_spec(context, spec)


@router.get("/v1/jobs", responses=problem_responses())
def get_jobs(
    page: PageDep,
    context: ContextDep,
    search: Annotated[
        str, Query(max_length=100, description="part of the name, kind, id or dataset")
    ] = "",
    state: Annotated[JobState | None, Query(description="only jobs in this state")] = None,
    project: Annotated[str, Query(max_length=100, description="only jobs of this project")] = "",
) -> Page[Job]:
    """List jobs, newest first."""
    with context.database.read() as connection:
        return list_jobs(context, connection, page, search, state, project)


@router.get("/v1/jobs/{job_id}", responses=problem_responses(404))
def get_job(job_id: str, context: ContextDep) -> JobDetail:
    """Return a job."""
    with context.database.read() as connection:
        return show_job(context, connection, int(find_job(connection, job_id).seq))


@router.patch("/v1/jobs/{job_id}", **reads("JobPatch", answers=_CHANGED))
def patch_job(
    job_id: str,
    patch: Annotated[JobPatch, Depends(JsonBody(JobPatch, max_bytes=SMALL_BYTES))],
    context: ContextDep,
) -> JobDetail:
    """Set the priority of a job, from its next task on. 409: it has ended."""
    return control.prioritise_job(context, job_id, patch.priority)


@router.post("/v1/jobs/{job_id}:cancel", status_code=202, responses=_CHANGED)
def cancel_job(job_id: str, context: ContextDep) -> JobDetail:
    """Cancel a job. Tasks that only it needs are dropped; finished results and datasets stay."""
    return control.cancel_job(context, job_id)


@router.post("/v1/jobs/{job_id}:pause", status_code=202, responses=_CHANGED)
def pause_job(job_id: str, context: ContextDep) -> JobDetail:
    """Pause a job: no further tasks start, running ones finish. It keeps its place in the queue."""
    return control.pause_job(context, job_id)


@router.post("/v1/jobs/{job_id}:resume", status_code=202, responses=_CHANGED)
def resume_job(job_id: str, context: ContextDep) -> JobDetail:
    """Resume a paused job."""
    return control.resume_job(context, job_id)


@router.post("/v1/jobs/{job_id}/tasks/{task_id}:retry", status_code=202, responses=_CHANGED)
def retry_task(job_id: str, task_id: str, context: ContextDep) -> JobDetail:
    """Let a failed task run again, with all its tries. 409: the job has ended, or it did not fail.

    A task that waits for its next try runs at once.
    """
    return control.retry_task(context, job_id, task_id)


@router.get("/v1/jobs/{job_id}/samples", responses=problem_responses(404))
def get_samples(
    job_id: str,
    page: PageDep,
    context: ContextDep,
    state: Annotated[
        TaskState | None,
        Query(description="only samples in this state; `rejected` lists the rejects"),
    ] = None,
) -> Page[SampleState]:
    """List the samples of a job by slot; empty until the job is planned."""
    with context.database.read() as connection:
        return list_samples(connection, find_job(connection, job_id).seq, page, state)


@router.get("/v1/jobs/{job_id}/previews", responses=problem_responses(404))
def get_previews(job_id: str, context: ContextDep) -> list[Preview]:
    """List the previews of finished samples."""
    with context.database.read() as connection:
        return list_previews(connection, find_job(connection, job_id).seq)


@router.get(
    "/v1/jobs/{job_id}/events",
    response_class=Response,
    responses={
        200: {
            "description": (
                "Server-sent events: `job.state`, `task.state`, `dataset.published` with "
                "increasing ids, and `job.progress` (about once a second, with the id of the event "
                "before it). After the `job.state` that ends the job the stream ends."
            ),
            "content": {"text/event-stream": STREAM},
        },
        **problem_responses(404, 429),
    },
)
def get_events(
    job_id: str,
    request: Request,
    context: ContextDep,
    last_event_id: Annotated[
        str | None,
        Header(pattern=EVENT_ID_PATTERN, description="id of the last event that you have"),
    ] = None,
) -> Response:
    """Stream the events of a job."""
    with context.database.read() as connection:
        job = int(find_job(connection, job_id).seq)
    feeds: Feeds = request.app.state.feeds
    return feeds.stream(job, after=int(last_event_id or 0))
