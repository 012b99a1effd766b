"""The worker API: dispatchers register, lease tasks, send heartbeats, and report results. Tasks can be read, too."""

import asyncio
from collections.abc import Callable
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Depends, Request, Response
from pydantic import BaseModel
from stickslip_schemas.documents.responses import WorkerEntry
from stickslip_schemas.documents.worker_api import (
    Heartbeat,
    HeartbeatAnswer,
    LeaseBatch,
    LeaseRequest,
    ReportAnswer,
    ReportBatch,
    WorkerRegistration,
    WorkerSession,
)

from stickslip_services.api.bodies import JsonBody, body_schema
from stickslip_services.api.metrics import Metrics
from stickslip_services.api.routes.common import BODY_PROBLEMS, KEYED, ContextDep, problem_responses
from stickslip_services.queue.compose import find_task
from stickslip_services.queue.context import Context
from stickslip_services.queue.lease import heartbeat, lease_tasks, register_worker
from stickslip_services.queue.report import report_results
from stickslip_services.queue.workers import show_workers

T = TypeVar("T")
_Route = TypeVar("_Route", bound=Callable[..., Any])

router = APIRouter()

_LEASE_REQUEST: JsonBody[LeaseRequest] = JsonBody(LeaseRequest)
_HEARTBEAT: JsonBody[Heartbeat] = JsonBody(Heartbeat)
_REPORT_BATCH: JsonBody[ReportBatch] = JsonBody(ReportBatch)


def _verb(name: str, document: type[BaseModel], answer: type[BaseModel], *refusals: int) -> Callable[[_Route], _Route]:
    """Return the decorator of a route that workers post a document to."""
    return router.post(
        f"/v1/worker/{name}",
        tags=["workers"],
        response_model=answer,
        responses=problem_responses(*refusals, *BODY_PROBLEMS),
        openapi_extra=body_schema(document.__name__) | KEYED,
    )


@router.get("/v1/workers", tags=["workers"], responses=problem_responses())
def get_workers(context: ContextDep) -> list[WorkerEntry]:
    """List the workers that have registered, the newest session of each name, newest first."""
    with context.database.read() as connection:
        return show_workers(context, connection)


@router.post(
    "/v1/workers",
    tags=["workers"],
    status_code=201,
    responses=problem_responses(*BODY_PROBLEMS),
    openapi_extra=body_schema("WorkerRegistration") | KEYED,
)
def post_worker(
    registration: Annotated[WorkerRegistration, Depends(JsonBody(WorkerRegistration))], context: ContextDep
) -> WorkerSession:
    """Register a worker. An earlier session of the name loses its leases at once."""
    return register_worker(context, registration)


@_verb("lease", LeaseRequest, LeaseBatch, 404, 409)
async def post_lease(request: Request) -> Response:
    """Lease tasks. 404 `unknown_worker`: register again. 409: a newer session of the name has taken over."""
    return await _answer(request, _LEASE_REQUEST, lease_tasks)


@_verb("heartbeat", Heartbeat, HeartbeatAnswer, 404)
async def post_heartbeat(request: Request) -> Response:
    """Renew leases and learn which tasks to drop."""
    return await _answer(request, _HEARTBEAT, heartbeat)


@_verb("report", ReportBatch, ReportAnswer, 404)
async def post_report(request: Request) -> Response:
    """Report how leased tasks ended. Each report is judged by itself; the first result of a lease counts."""
    metrics: Metrics = request.app.state.metrics

    def report(context: Context, batch: ReportBatch) -> ReportAnswer:
        answer = report_results(context, batch)
        metrics.count_reports(batch, answer)
        return answer

    return await _answer(request, _REPORT_BATCH, report)


@router.get(
    "/v1/tasks/{task_id}",
    tags=["tasks"],
    response_class=Response,
    responses={
        200: {
            "description": "The task",
            "content": {"application/json": {"schema": {"$ref": "#/components/schemas/Task"}}},
        },
        **problem_responses(404, 409),
    },
)
def get_task(task_id: str, context: ContextDep) -> Response:
    """Return a task as a worker gets it. 409: one of its dependencies has not ended yet."""
    with context.database.read() as connection:
        task = find_task(connection, task_id, context.store.publish)
    return Response(task.model_dump_json(), media_type="application/json")


async def _answer(request: Request, document: JsonBody[T], verb: Callable[[Context, T], BaseModel]) -> Response:
    """Read a document, call a verb with it, and serialise the answer, all in one call of one thread.

    Workers ask many times a second. The answer, which may have megabytes, is not validated a second time.
    """
    context: Context = request.app.state.context
    body = await document.received(request)

    def work() -> str:
        return verb(context, document.read(body)).model_dump_json()

    return Response(await asyncio.to_thread(work), media_type="application/json")
