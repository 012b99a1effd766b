"""The worker API: dispatchers register, lease tasks, send heartbeats, and report results.

Tasks can be read, too.
"""

import asyncio
from collections.abc import Callable, Coroutine
from inspect import iscoroutinefunction
from typing import Annotated, Any, Generic, TypeVar

from fastapi import APIRouter, Depends, Request, Response
from fastapi.routing import APIRoute
from pydantic import BaseModel
from stickslip_schemas.documents import worker_api
from stickslip_schemas.documents.responses import WorkerEntry

from stickslip_services.api.routes.common import (
    ContextDep,
    JsonBody,
    json_content,
    problem_responses,
    reads,
)
from stickslip_services.api.routes.health import Metrics
from stickslip_services.queue.compose import find_task
from stickslip_services.queue.context import Context
from stickslip_services.queue.heartbeat import reconcile_leases
from stickslip_services.queue.lease import lease_tasks, register_worker
from stickslip_services.queue.report import report_results
from stickslip_services.queue.workers import show_workers

T = TypeVar("T")
U = TypeVar("U")

MOST_ON_LOOP = 64 * 2**10
"""Heartbeats of at most so many bytes are read by the event loop, in 2 ms; longer ones by a thread.
"""
MOST_TOGETHER = 64
"""Heartbeats that are answered with one statement: about 5 ms."""

_LEASE_REQUEST: JsonBody[worker_api.LeaseRequest] = JsonBody(
    worker_api.LeaseRequest, from_workers=True
)
_HEARTBEAT: JsonBody[worker_api.Heartbeat] = JsonBody(worker_api.Heartbeat, from_workers=True)
_REPORT_BATCH: JsonBody[worker_api.ReportBatch] = JsonBody(
    worker_api.ReportBatch, from_workers=True
)


class _Plain(APIRoute):
    """A route for which FastAPI resolves nothing if its function is asynchronous: that takes the
    request itself.
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        return self.endpoint if iscoroutinefunction(self.endpoint) else super().get_route_handler()


router = APIRouter(route_class=_Plain)


@router.get("/v1/workers", responses=problem_responses())
def get_workers(context: ContextDep) -> list[WorkerEntry]:
    """List the workers that have registered, the newest session of each name, newest first."""
    with context.database.read() as connection:
        return show_workers(context, connection)


@router.post("/v1/workers", status_code=201, **reads("WorkerRegistration"))
def post_worker(
    registration: Annotated[
        worker_api.WorkerRegistration, Depends(JsonBody(worker_api.WorkerRegistration))
    ],
    context: ContextDep,
) -> worker_api.WorkerSession:
    """Register a worker. An earlier session of the name loses its leases at once."""
    return register_worker(context, registration)


@router.post(
    "/v1/worker/lease", response_model=worker_api.LeaseBatch, **reads("LeaseRequest", 404, 409)
)
async def post_lease(request: Request) -> Response:
    """Lease tasks. 404 `unknown_worker`: register again. 409: a newer session of the name has taken
    over.
    """
    return await _answer(request, _LEASE_REQUEST, lease_tasks)


@router.post(
    "/v1/worker/heartbeat", response_model=worker_api.HeartbeatAnswer, **reads("Heartbeat", 404)
)
async def post_heartbeat(request: Request) -> Response:
    """Renew leases and learn which tasks to drop."""
    body = await _HEARTBEAT.received(request)
    is_long = len(body) > MOST_ON_LOOP
    message = await asyncio.to_thread(_HEARTBEAT.read, body) if is_long else _HEARTBEAT.read(body)
    left = await request.app.state.renewals.add(message)
    answer = worker_api.HeartbeatAnswer(drop=())
    if left is not None:
        answer = await asyncio.to_thread(reconcile_leases, request.app.state.context, message, left)
    return Response(answer.model_dump_json(), media_type="application/json")


class Batcher(Generic[T, U]):
    """Calls a function in a thread: once for all items that have come while its last call was
    running.
    """

    def __init__(self, call: Callable[[list[T]], list[U]]) -> None:
        self._call = call
        self._waiting: list[tuple[T, asyncio.Future[U]]] = []
        self._task: asyncio.Task[None] | None = None

    async def add(self, item: T) -> U:
        future: asyncio.Future[U] = asyncio.get_running_loop().create_future()
        self._waiting.append((item, future))
        if self._task is None:
            self._task = asyncio.create_task(self._work())
        return await future

    async def _work(self) -> None:
        while self._waiting:
            batch, self._waiting = self._waiting[:MOST_TOGETHER], self._waiting[MOST_TOGETHER:]
            try:
                results = await asyncio.to_thread(self._call, [item for item, _ in batch])
            except Exception as error:
                for _, future in batch:
                    if not future.cancelled():
                        future.set_exception(error)
                continue
            for (_, future), result in zip(batch, results, strict=True):
                if not future.cancelled():
                    future.set_result(result)
        self._task = None


@router.post(
    "/v1/worker/report", response_model=worker_api.ReportAnswer, **reads("ReportBatch", 404)
)
async def post_report(request: Request) -> Response:
    """Report how leased tasks ended.

    Each report is judged by itself; the first result of a lease counts.
    """
    metrics: Metrics = request.app.state.metrics

    def report(context: Context, batch: worker_api.ReportBatch) -> worker_api.ReportAnswer:
        answer = report_results(context, batch)
        metrics.count_reports(batch, answer)
        return answer

    return await _answer(request, _REPORT_BATCH, report)


@router.get(
    "/v1/tasks/{task_id}",
    response_class=Response,
    responses={
        200: {"description": "The task", "content": json_content("Task")},
        **problem_responses(404, 409),
    },
)
def get_task(task_id: str, context: ContextDep) -> Response:
    """Return a task as a worker gets it. 409: one of its dependencies has not ended yet."""
    with context.database.read() as connection:
        task = find_task(connection, task_id, context.store.publish)
    return Response(task.model_dump_json(), media_type="application/json")


async def _answer(
    request: Request, document: JsonBody[T], verb: Callable[[Context, T], BaseModel]
) -> Response:
    """Read a document, call a verb with it, and serialise the answer, all in one call of one
    thread.

    Workers ask many times a second. The answer, which may have megabytes, is not validated a second
    time.
    """
    context: Context = request.app.state.context
    body = await document.received(request)

    def work() -> str:
        return verb(context, document.read(body)).model_dump_json()

    return Response(await asyncio.to_thread(work), media_type="application/json")
