"""The worker API: a dispatcher registers, leases tasks, says that it lives, and reports."""

import asyncio
from collections.abc import Callable
from typing import Annotated, TypeVar

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
from stickslip_services.api.routes.common import BODY_PROBLEMS, KEYED, coordinator_of, problem_responses
from stickslip_services.queue.coordinator import Coordinator
from stickslip_services.queue.workers import show_workers

T = TypeVar("T")

router = APIRouter(tags=["workers"])

_LEASE_REQUEST: JsonBody[LeaseRequest] = JsonBody(LeaseRequest)
_HEARTBEAT: JsonBody[Heartbeat] = JsonBody(Heartbeat)
_REPORT_BATCH: JsonBody[ReportBatch] = JsonBody(ReportBatch)

CoordinatorDep = Annotated[Coordinator, Depends(coordinator_of)]


@router.get("/v1/workers", responses=problem_responses())
def get_workers(coordinator: CoordinatorDep) -> list[WorkerEntry]:
    """List the workers that have registered, the newest session of each name, newest first."""
    with coordinator.database.read() as connection:
        return show_workers(connection, alive_since=coordinator.alive_since, frames=coordinator.frames)


@router.post(
    "/v1/workers",
    status_code=201,
    responses=problem_responses(*BODY_PROBLEMS),
    openapi_extra=body_schema("WorkerRegistration") | KEYED,
)
def post_worker(
    registration: Annotated[WorkerRegistration, Depends(JsonBody(WorkerRegistration))], coordinator: CoordinatorDep
) -> WorkerSession:
    """Register a worker. An earlier session of the name loses its leases at once."""
    return coordinator.register(registration)


@router.post(
    "/v1/worker/lease",
    response_model=LeaseBatch,
    responses=problem_responses(404, 409, *BODY_PROBLEMS),
    openapi_extra=body_schema("LeaseRequest") | KEYED,
)
async def post_lease(request: Request) -> Response:
    """Lease tasks. 404 `unknown_worker`: register again. 409: a newer session of the name has taken over."""
    coordinator: Coordinator = coordinator_of(request)
    return await _answer(request, _LEASE_REQUEST, coordinator.lease)


@router.post(
    "/v1/worker/heartbeat",
    response_model=HeartbeatAnswer,
    responses=problem_responses(404, *BODY_PROBLEMS),
    openapi_extra=body_schema("Heartbeat") | KEYED,
)
async def post_heartbeat(request: Request) -> Response:
    """Renew leases and learn which tasks to drop."""
    coordinator: Coordinator = coordinator_of(request)
    return await _answer(request, _HEARTBEAT, coordinator.heartbeat)


@router.post(
    "/v1/worker/report",
    response_model=ReportAnswer,
    responses=problem_responses(404, *BODY_PROBLEMS),
    openapi_extra=body_schema("ReportBatch") | KEYED,
)
async def post_report(request: Request) -> Response:
    """Report how leased tasks ended. Each report is judged by itself; the first result of a lease counts."""
    coordinator: Coordinator = coordinator_of(request)
    metrics: Metrics = request.app.state.metrics

    def report(batch: ReportBatch) -> ReportAnswer:
        answer = coordinator.report(batch)
        metrics.count_reports(batch, answer)
        return answer

    return await _answer(request, _REPORT_BATCH, report)


async def _answer(request: Request, document: JsonBody[T], verb: Callable[[T], BaseModel]) -> Response:
    """Read a document, do what it says and write the answer, all in one go in one thread.

    Workers ask many times a second. The answer, which may have megabytes, is not validated a second time.
    """
    body = await document.received(request)

    def work() -> str:
        return verb(document.read(body)).model_dump_json()

    return Response(await asyncio.to_thread(work), media_type="application/json")
