"""The worker API: dispatchers register, lease tasks, send heartbeats, and report results.

Tasks can be read, too.
"""

import asyncio
from collections.abc import Callable
from inspect import iscoroutinefunction
from typing import Annotated, Generic, TypeVar

from fastapi import APIRouter, Depends, Request, Response
from pydantic import BaseModel
from stickslip_schemas.documents import worker_api
from stickslip_schemas.documents.responses import WorkerEntry

from stickslip_services.api.bodies import SMALL_BYTES, JsonBody
from stickslip_services.api.routes.common import (
    ContextDep,
    Handler,
    StrictRoute,
    json_content,
    problem_responses,
    reads,
)
from stickslip_services.api.routes.health import Metrics
from stickslip_services.queue.context import Context
from stickslip_services.queue.documents import find_task
from stickslip_services.queue.heartbeat import reconcile_leases
from stickslip_services.queue.lease import lease_tasks, register_worker
from stickslip_services.queue.results import report_results
from stickslip_services.queue.workers import show_workers

T = TypeVar("T")
U = TypeVar("U")

MAX_BYTES_ON_LOOP = 64 * 2**10
"""The event loop itself reads heartbeats up to this size [bytes], in 2 ms; a thread reads longer
ones.
"""

MAX_BATCH = 64
"""Heartbeats that are answered with one statement: about 5 ms."""

MAX_CONTAINERS = 500_000
"""Lists and objects in a heartbeat or a report, which name a thousand tasks."""

_LEASE_REQUEST: JsonBody[worker_api.LeaseRequest] = JsonBody(
    worker_api.LeaseRequest, max_bytes=SMALL_BYTES, from_workers=True
)
_HEARTBEAT: JsonBody[worker_api.Heartbeat] = JsonBody(
    worker_api.Heartbeat, max_containers=MAX_CONTAINERS, from_workers=True
)
_REPORT_BATCH: JsonBody[worker_api.ReportBatch] = JsonBody(
    worker_api.ReportBatch, max_containers=MAX_CONTAINERS, from_workers=True
)


class _WorkerRoute(StrictRoute):
    """A route whose function, if asynchronous, takes the request itself.

    FastAPI resolves nothing for it: that would take longer than answering a heartbeat.
    """

    def plain_handler(self) -> Handler:
        """Return the function of the route if it is asynchronous."""
        if iscoroutinefunction(self.endpoint):
            return self.endpoint
        return super().plain_handler()


router = APIRouter(route_class=_WorkerRoute)


@router.get("/v1/workers", responses=problem_responses())
def get_workers(context: ContextDep) -> list[WorkerEntry]:
    """List the workers that have registered, the newest session of each name, newest first."""
    with context.database.read() as connection:
        return show_workers(context, connection)


@router.post("/v1/workers", status_code=201, **reads("WorkerRegistration"))
def post_worker(
    registration: Annotated[
        worker_api.WorkerRegistration,
        Depends(JsonBody(worker_api.WorkerRegistration, max_bytes=SMALL_BYTES)),
    ],
    context: ContextDep,
) -> worker_api.WorkerSession:
    """Register a worker. An earlier session of the name loses its leases at once."""
    return register_worker(context, registration)


@router.post(
    "/v1/worker/lease", response_model=worker_api.LeaseBatch, **reads("LeaseRequest", 404, 409)
)
async def post_lease(request: Request) -> Response:
    """Lease tasks.

    404 `unknown_worker`: register again. 409: a newer session of the name has taken over.
    """
    return await _answer(request, _LEASE_REQUEST, lease_tasks)


@router.post(
    "/v1/worker/heartbeat", response_model=worker_api.HeartbeatAnswer, **reads("Heartbeat", 404)
)
async def post_heartbeat(request: Request) -> Response:
    """Renew leases and learn which tasks to drop."""
    body = await _HEARTBEAT.receive(request)
    if len(body) > MAX_BYTES_ON_LOOP:
        heartbeat = await asyncio.to_thread(_HEARTBEAT.read, body)
    else:
        heartbeat = _HEARTBEAT.read(body)

    # Most heartbeats only renew leases: one statement does that for many workers. The others differ
    # from the database, for example by a task that has started, and take a transaction each.
    disputed = await request.app.state.renewals.add(heartbeat)
    if disputed is None:
        answer = worker_api.HeartbeatAnswer(drop=())
    else:
        context: Context = request.app.state.context
        answer = await asyncio.to_thread(reconcile_leases, context, heartbeat, disputed)
    return Response(answer.model_dump_json(), media_type="application/json")


class Batcher(Generic[T, U]):
    """Calls a function once for all items that have come while its last call was running.

    The function runs in a thread, and returns a result for each item.
    """

    def __init__(self, call: Callable[[list[T]], list[U]]) -> None:
        self._call = call
        self._waiting: list[tuple[T, asyncio.Future[U]]] = []
        self._task: asyncio.Task[None] | None = None

    async def add(self, item: T) -> U:
        """Return the result of an item; raise what the call for its batch raised."""
        future: asyncio.Future[U] = asyncio.get_running_loop().create_future()
        self._waiting.append((item, future))
        if self._task is None:
            self._task = asyncio.create_task(self._run())
        return await future

    async def _run(self) -> None:
        while self._waiting:
            batch = self._waiting[:MAX_BATCH]
            self._waiting = self._waiting[MAX_BATCH:]
            items = [item for item, _ in batch]
            call = asyncio.create_task(asyncio.to_thread(self._call, items))
            await asyncio.wait([call])
            # An error belongs to the requests of this batch; the next batch may succeed.
            error = call.exception()
            results = [] if error is not None else call.result()
            for position, (_, future) in enumerate(batch):
                if future.cancelled():
                    continue  # the client has gone
                if error is not None:
                    future.set_exception(error)
                else:
                    future.set_result(results[position])
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
    """Read a document, call a verb with it, and serialise the answer, in one call of one thread.

    Workers ask many times a second. The answer, which may have megabytes, is not validated a second
    time.
    """
    context: Context = request.app.state.context
    body = await document.receive(request)

    def work() -> str:
        return verb(context, document.read(body)).model_dump_json()

    return Response(await asyncio.to_thread(work), media_type="application/json")
