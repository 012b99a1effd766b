"""The client of the worker API: requests and the back-off between them, the leases held, and their
heartbeat.
"""

import contextlib
import logging
import math
import random
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import httpx
from pydantic import BaseModel
from stickslip_schemas.documents import worker_api as api
from stickslip_schemas.documents.problems import ProblemCode
from stickslip_schemas.documents.tasks import TaskResult

log = logging.getLogger(__name__)

Answer = TypeVar("Answer", bound=BaseModel)

PROMPT = httpx.Timeout(30, connect=5)
PATIENT = httpx.Timeout(300, connect=5)
"""Timeout of a lease and a report: for a version of a million samples, the coordinator lists or
checks all files.
"""

REPORTS_A_REQUEST = 512

REPORT_SECONDS = 1.0
"""How long a result waits for others to be reported with, while there is other work to go on with.
"""

START_BEAT_SECONDS = 2.0
"""Time between two heartbeats of a dispatcher that starts, which tell how far it is [s]."""

LAST_BEAT_SECONDS = 5.0
"""Time limit of a heartbeat in progress when the thread is stopped."""


class CoordinatorError(Exception):
    """The coordinator refuses this dispatcher: a newer one has its name, or a request would fail
    every time.
    """


class UnreachableError(CoordinatorError):
    """No answer, or an answer that asks for another attempt later."""


class UnknownWorkerError(UnreachableError):
    """The coordinator does not know the session: the next heartbeat registers again."""


def pinned(certificate: Path) -> ssl.SSLContext:
    """Return a context that trusts a server with this certificate, under any host name."""
    context = ssl.create_default_context(cafile=str(certificate))
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    context.check_hostname = False
    return context


class CoordinatorClient:
    """Client of the worker API. Thread-safe."""

    def __init__(
        self, urls: Sequence[str], key: str | None = None, tls_certificate: Path | None = None
    ) -> None:
        # trust_env=False: the coordinator is not reached through a proxy of the environment.
        headers = {"Content-Type": "application/json"} | (
            {} if key is None else {"Authorization": f"Bearer {key}"}
        )
        verify = True if tls_certificate is None else pinned(tls_certificate)
        self._http = httpx.Client(headers=headers, verify=verify, trust_env=False)
        self._urls = deque(url.rstrip("/") for url in urls)
        """Of coordinators with one database; the first one is asked."""

    def register(self, registration: api.WorkerRegistration) -> api.WorkerSession:
        return self._post("/v1/workers", registration, api.WorkerSession)

    def lease(self, request: api.LeaseRequest) -> api.LeaseBatch:
        return self._post("/v1/worker/lease", request, api.LeaseBatch, timeout=PATIENT)

    def heartbeat(self, heartbeat: api.Heartbeat) -> api.HeartbeatAnswer:
        return self._post("/v1/worker/heartbeat", heartbeat, api.HeartbeatAnswer)

    def report(self, reports: api.ReportBatch) -> api.ReportAnswer:
        return self._post("/v1/worker/report", reports, api.ReportAnswer, timeout=PATIENT)

    def close(self) -> None:
        self._http.close()

    def _post(
        self,
        path: str,
        document: BaseModel,
        answer: type[Answer],
        *,
        timeout: httpx.Timeout = PROMPT,
    ) -> Answer:
        url = self._urls[0]
        try:
            response = self._http.post(
                url + path, content=document.model_dump_json(), timeout=timeout
            )
        except httpx.TransportError as error:
            if self._urls[0] == url:  # no other thread has turned from it
                self._urls.rotate(-1)
            raise UnreachableError(f"{url}{path}: {type(error).__name__}: {error}") from error
        if response.status_code >= 500 or response.status_code == 429:
            raise UnreachableError(f"{path}: {response.status_code} {response.text[:500]}")
        if response.is_success:
            return answer.model_validate_json(response.content)
        is_unknown = response.status_code == 404 and ProblemCode.unknown_worker in response.text
        kind = UnknownWorkerError if is_unknown else CoordinatorError
        raise kind(f"{path}: {response.status_code} {response.text[:500]}")


class Backoff:
    """Doubles the wait after each failure, with jitter so that many dispatchers do not return at
    once.
    """

    def __init__(self, *, first: float = 0.2, most: float = 5.0) -> None:
        self._first, self._most, self._delay = first, most, first
        self.next_try = 0.0
        """Earliest time of the next attempt, on the monotonic clock [s]."""

    def failed(self) -> float:
        """Note a failure and double the wait; return it [s]."""
        delay = self._delay * random.uniform(0.5, 1.0)
        self._delay = min(2 * self._delay, self._most)
        self.next_try = time.monotonic() + delay
        return delay

    def succeeded(self) -> None:
        self._delay, self.next_try = self._first, 0.0


class LeaseBook:
    """The leases that the dispatcher holds, and the results that wait to be reported. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._states: dict[str, api.LeaseState] = {}
        self._reports: dict[str, api.Report] = {}
        self.due = math.inf
        """When to report at the latest."""

    def add(self, leases: Iterable[api.Lease]) -> None:
        """Add leases; they take the place of older ones of the same tasks."""
        with self._lock:
            for lease in leases:
                self._states[lease.task_id] = api.LeaseState(
                    task_id=lease.task_id, token=lease.token, started=False
                )
                self._reports.pop(lease.task_id, None)

    def note(self, leases: Iterable[api.Lease], **changes: object) -> None:
        """Note that tasks have `started`, or their `frames`: (frames done, frames total)."""
        with self._lock:
            for lease in leases:
                if self.holds(lease):
                    self._states[lease.task_id] = self._states[lease.task_id].model_copy(
                        update=changes
                    )

    def settle(self, lease: api.Lease | api.LeaseState, result: TaskResult | None) -> None:
        """Keep the result of a lease that is still held, or its return, until it is reported."""
        with self._lock:
            if self.holds(lease):
                self.due = min(self.due, time.monotonic() + REPORT_SECONDS)
                self._reports[lease.task_id] = api.Report(
                    task_id=lease.task_id, token=lease.token, result=result
                )

    def give_back(self, *, started: bool) -> None:
        """Return the leases that have no result, those of started tasks only if `started`."""
        for state in self.states():
            if state.task_id not in self._reports and (started or not state.started):
                self.settle(state, None)

    def remove(self, leases: Iterable[api.Lease | api.LeaseState | api.Report]) -> None:
        """Remove leases; newer ones of the same tasks stay."""
        with self._lock:
            for lease in leases:
                if self.holds(lease):
                    del self._states[lease.task_id]
                    self._reports.pop(lease.task_id, None)

    def holds(self, lease: api.Lease | api.LeaseState | api.Report) -> bool:
        state = self._states.get(lease.task_id)
        return state is not None and state.token == lease.token

    def states(self) -> tuple[api.LeaseState, ...]:
        with self._lock:
            return tuple(self._states.values())

    def reports(self) -> tuple[api.Report, ...]:
        with self._lock:
            return tuple(self._reports.values())


class Session(threading.Thread):
    """Registers the dispatcher, and renews its leases three times in the duration of a lease, and
    more often at the start.

    It is a daemon and never keeps the process alive.
    """

    def __init__(
        self, coordinator: CoordinatorClient, registration: Callable[[], api.WorkerRegistration]
    ) -> None:
        super().__init__(name="session", daemon=True)
        self._coordinator = coordinator
        self._registration = registration
        self.book = LeaseBook()
        self._worker_id = ""
        self._interval = 0.0
        self._wanted, self._opened = 1, 0
        """How many sessions there should have been, and the number of the one that is open."""
        self._ended = False
        self._wake = threading.Event()
        self.error: CoordinatorError | None = None
        """Why the coordinator refuses this dispatcher."""

    @property
    def worker_id(self) -> str | None:
        """The worker that this dispatcher is to the coordinator; None while no session is open."""
        if self.error is not None:
            raise self.error
        return self._worker_id if self._opened == self._wanted else None

    def renew(self) -> None:
        """Register anew: the coordinator does not know the session, or the dispatcher has more to
        say about itself.
        """
        self._wanted += 1
        self._wake.set()

    def beat(self) -> float:
        """Send one heartbeat; return when the next one is due [s]."""
        states, condition = self.book.states(), self._registration().condition
        message = api.Heartbeat(worker_id=self._worker_id, leases=states, condition=condition)
        if drop := set(self._coordinator.heartbeat(message).drop):
            log.info("dropping %d tasks", len(drop))
            self.book.remove(state for state in states if state.task_id in drop)
        return (
            self._interval
            if condition.state == "ready"
            else min(START_BEAT_SECONDS, self._interval)
        )

    def report(self, worker_id: str) -> bool:
        """Send all results that wait; return whether there were any."""
        reports = self.book.reports()
        for first in range(0, len(reports), REPORTS_A_REQUEST):
            batch = reports[first : first + REPORTS_A_REQUEST]
            for verdict in self._coordinator.report(
                api.ReportBatch(worker_id=worker_id, reports=batch)
            ).verdicts:
                if verdict.verdict == "stale":
                    log.warning(
                        "the report of task %s came too late and was refused", verdict.task_id
                    )
            self.book.remove(batch)
        self.book.due = math.inf
        return bool(reports)

    def tell(self) -> None:
        """Let the coordinator know at once how the dispatcher is."""
        self._wake.set()

    def close(self) -> None:
        """Give all leases back and say why it ends, if the coordinator listens, and end the
        session.
        """
        self.book.give_back(started=True)
        with contextlib.suppress(CoordinatorError):
            if (worker_id := self.worker_id) is not None:
                self.report(worker_id)
                self.beat()
        self._ended = True
        self._wake.set()
        self.join(LAST_BEAT_SECONDS)  # a heartbeat in progress may end first
        self._coordinator.close()

    def run(self) -> None:
        """Keep the session until `close`."""
        backoff = Backoff()
        while not self._ended:
            try:
                if self._opened != self._wanted:
                    self._open()
                wait = self.beat()
                backoff.succeeded()
            except UnknownWorkerError:
                self.renew()
                continue
            except UnreachableError as error:
                log.warning("the coordinator is away: %s", error)
                wait = backoff.failed()
            except CoordinatorError as error:
                log.error("the coordinator refuses this dispatcher: %s", error)
                self.error = error
                return
            self._wake.wait(wait)
            self._wake.clear()

    def _open(self) -> None:
        """Register.

        What was leased in an earlier session is lost; the coordinator gives it out again.
        """
        wanted = self._wanted
        session = self._coordinator.register(self._registration())
        self.book.remove(self.book.states())
        self._worker_id, self._interval, self._opened = (
            session.worker_id,
            session.lease_seconds / 3,
            wanted,
        )
        log.info("registered as %s", session.worker_id)
