"""The worker API: a dispatcher registers, leases tasks, says that it lives, and reports."""

from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response
from stickslip_schemas.responses import WorkerEntry
from stickslip_schemas.worker_api import (
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

router = APIRouter(tags=["workers"])

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
def post_lease(
    request: Annotated[LeaseRequest, Depends(JsonBody(LeaseRequest))], coordinator: CoordinatorDep
) -> Response:
    """Lease tasks. 404 `unknown_worker`: register again. 409: a newer session of the name has taken over."""
    # A batch may be megabytes: written as it is, not validated a second time.
    return Response(coordinator.lease(request).model_dump_json(), media_type="application/json")


@router.post(
    "/v1/worker/heartbeat",
    responses=problem_responses(404, *BODY_PROBLEMS),
    openapi_extra=body_schema("Heartbeat") | KEYED,
)
def post_heartbeat(
    heartbeat: Annotated[Heartbeat, Depends(JsonBody(Heartbeat))], coordinator: CoordinatorDep
) -> HeartbeatAnswer:
    """Renew leases and learn which tasks to drop."""
    return coordinator.heartbeat(heartbeat)


@router.post(
    "/v1/worker/report",
    responses=problem_responses(404, *BODY_PROBLEMS),
    openapi_extra=body_schema("ReportBatch") | KEYED,
)
def post_report(
    batch: Annotated[ReportBatch, Depends(JsonBody(ReportBatch))], coordinator: CoordinatorDep, request: Request
) -> ReportAnswer:
    """Report how leased tasks ended. Each report is judged by itself; the first result of a lease counts."""
    answer = coordinator.report(batch)
    metrics: Metrics = request.app.state.metrics
    metrics.count_reports(batch, answer)
    return answer
