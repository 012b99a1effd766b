"""A coordinator for tests of the dispatcher: speaks the worker API, and does on demand what a real
one seldom does.
"""

import json
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from pydantic import BaseModel
from stickslip_schemas.documents.tasks import TaskResult
from stickslip_schemas.documents.worker_api import (
    Heartbeat,
    HeartbeatAnswer,
    Lease,
    LeaseBatch,
    LeaseRequest,
    ReportAnswer,
    ReportBatch,
    ReportVerdict,
    WorkerCondition,
    WorkerRegistration,
    WorkerSession,
)


class CoordinatorDouble:
    """Tasks are given out once, in order.

    `results`, `released` and `started` say what became of them.
    """

    lease_seconds = 0.6

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.changed = threading.Condition(self.lock)
        self.registrations: list[WorkerRegistration] = []
        self.waiting: list[tuple[str, Any]] = []
        self.leased_tasks: list[tuple[str, Any]] = []
        self.leased: dict[str, int] = {}
        self.started: set[str] = set()
        self.beats = 0
        self.results: dict[str, TaskResult] = {}
        self.released: list[str] = []
        self.drop: set[str] = set()
        self.stale: set[str] = set()
        self.superseded = False
        self.limits: dict[str, float] = {}
        self.long: set[str] = set()
        self.frames: dict[str, tuple[int, int]] = {}
        self.condition = WorkerCondition(slots=0)
        self._token = 0
        self._server: ThreadingHTTPServer | None = None
        self.port = 0

    # --- as a test sees it
    # -----------------------------------------------------------------------------------

    def start(self) -> str:
        double = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                with double.changed:
                    status, answer = double._answer(self.path, body)
                    double.changed.notify_all()
                data = (
                    answer.model_dump_json().encode()
                    if isinstance(answer, BaseModel)
                    else json.dumps(answer).encode()
                )
                self.send_response(status)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            def log_message(self, *_: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self._server.daemon_threads = True
        self.port = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()
        return f"http://127.0.0.1:{self.port}"

    def stop(self) -> None:
        """Go away: connections are refused until `start`, which listens on the same port."""
        assert self._server is not None
        self._server.shutdown()
        self._server.server_close()
        self._server = None

    def offer(self, **tasks: Any) -> None:
        with self.changed:
            self.waiting += tasks.items()

    def forget_sessions(self) -> None:
        with self.lock:
            self.registrations.clear()
            self.leased.clear()

    def until(self, condition: Callable[[], bool], timeout: float = 180) -> None:
        """Wait for a condition, which is looked at after every request."""
        with self.changed:
            assert self.changed.wait_for(condition, timeout), (
                self.results,
                self.leased,
                self.released,
            )

    # --- as a dispatcher sees it
    # -----------------------------------------------------------------------------

    def _answer(self, path: str, body: bytes) -> tuple[int, BaseModel | dict[str, str]]:
        if path == "/v1/workers":
            self.registrations.append(WorkerRegistration.model_validate_json(body))
            return 201, WorkerSession(
                worker_id=f"worker-{len(self.registrations)}", lease_seconds=self.lease_seconds
            )
        if not self.registrations:
            return 404, {"code": "unknown_worker"}
        if path == "/v1/worker/lease":
            if self.superseded:
                return 409, {"code": "conflict"}
            return 200, self._lease(LeaseRequest.model_validate_json(body))
        if path == "/v1/worker/heartbeat":
            return 200, self._beat(Heartbeat.model_validate_json(body))
        assert path == "/v1/worker/report"
        return 200, self._report(ReportBatch.model_validate_json(body))

    def _lease(self, request: LeaseRequest) -> LeaseBatch:
        wanted = dict(request.wanted)
        granted, left = [], []
        for name, task in self.waiting:
            is_left_out = request.at_most_seconds is not None and name in self.long
            if wanted.get(task.stage, 0) > 0 and not is_left_out:
                wanted[task.stage] -= 1
                self._token += 1
                self.leased[name] = self._token
                limit = self.limits.get(name)
                granted.append(
                    Lease(
                        task_id=name, token=self._token, attempt=1, limit_seconds=limit, task=task
                    )
                )
            else:
                left.append((name, task))
        self.waiting = left
        self.leased_tasks += [(lease.task_id, lease.task) for lease in granted]
        return LeaseBatch(leases=tuple(granted), retry_after_seconds=0 if granted else 0.05)

    def _beat(self, heartbeat: Heartbeat) -> HeartbeatAnswer:
        self.beats += 1
        self.condition = heartbeat.condition
        self.frames |= {
            lease.task_id: lease.frames for lease in heartbeat.leases if lease.frames is not None
        }
        self.started |= {lease.task_id for lease in heartbeat.leases if lease.started}
        return HeartbeatAnswer(
            drop=tuple(lease.task_id for lease in heartbeat.leases if lease.task_id in self.drop)
        )

    def _report(self, batch: ReportBatch) -> ReportAnswer:
        verdicts = []
        for report in batch.reports:
            if report.task_id in self.stale or self.leased.get(report.task_id) != report.token:
                verdicts.append(ReportVerdict(task_id=report.task_id, verdict="stale"))
                self.stale.discard(report.task_id)
                self.leased.pop(report.task_id, None)
                continue
            del self.leased[report.task_id]
            if report.result is None:
                self.released.append(report.task_id)
                self.waiting += [
                    item
                    for item in self.leased_tasks
                    if item[0] == report.task_id and item[0] in self.long
                ]
            else:
                self.results[report.task_id] = report.result
            verdicts.append(ReportVerdict(task_id=report.task_id, verdict="accepted"))
        return ReportAnswer(verdicts=tuple(verdicts))
