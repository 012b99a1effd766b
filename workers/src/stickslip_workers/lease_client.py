"""The client of the worker API: requests, the back-off, the leases held and their heartbeat."""

import contextlib
import logging
import math
import random
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import httpx
from pydantic import BaseModel
from stickslip_schemas.documents import worker_api as api
from stickslip_schemas.documents.problems import ProblemCode
from stickslip_schemas.documents.tasks import TaskResult

log = logging.getLogger(__name__)

Answer = TypeVar("Answer", bound=BaseModel)

SHORT_TIMEOUT = httpx.Timeout(30, connect=5)
"""Timeout of a registration and a heartbeat [s], which do little."""

LONG_TIMEOUT = httpx.Timeout(300, connect=5)
"""Timeout of a lease and a report [s].

For a version of a million samples, the coordinator lists or checks all files.
"""

REPORTS_A_REQUEST = 512
"""The most results in a request.

They take a few MB, and the coordinator stores them in one transaction.
"""

REPORT_SECONDS = 1.0
"""Time that a result waits for other results, while the dispatcher has other work [s]."""

HEARTBEATS_A_LEASE = 3
"""Heartbeats in the duration of a lease: two may be lost before it ends."""

START_BEAT_SECONDS = 2.0
"""Time between two heartbeats of a starting dispatcher, which report its progress [s]."""

LAST_BEAT_SECONDS = 5.0
"""Time limit of a heartbeat in progress after a stop of the thread [s]."""


class CoordinatorError(Exception):
    """The coordinator refuses this dispatcher.

    For example, a newer dispatcher has its name, or a request would fail every time.
    """


class UnreachableError(CoordinatorError):
    """The coordinator gave no answer, or asked for another attempt later."""


class UnknownWorkerError(UnreachableError):
    """The coordinator does not know the session: the next heartbeat registers again."""


def pinned(certificate: Path) -> ssl.SSLContext:
    """Return a context that trusts a server with this certificate, under any host name."""
    context = ssl.create_default_context(cafile=str(certificate))
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    context.check_hostname = False
    return context


class KeyFile(httpx.Auth):
    """Sends the key in a file. It is thread-safe.

    `stickslip keys rotate` replaces the key, and the coordinator refuses the old one some time
    later. The file is then read again, so that no dispatcher must be started again.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._key = self._read()

    def auth_flow(self, request: httpx.Request) -> Generator[httpx.Request, httpx.Response, None]:
        """Send a request, and repeat it once if its key is refused and the file has another."""
        key = self._key
        request.headers["Authorization"] = f"Bearer {key}"
        response = yield request
        if response.status_code != httpx.codes.UNAUTHORIZED:
            return
        # A missing file leaves the refusal of the coordinator as the answer.
        with contextlib.suppress(OSError):
            self._key = self._read()
        if self._key != key:
            log.info("the key of %s is another one now", self._path)
            request.headers["Authorization"] = f"Bearer {self._key}"
            yield request

    def _read(self) -> str:
        return self._path.read_text(encoding="ascii").strip()


class CoordinatorClient:
    """Client of the worker API. It is thread-safe."""

    def __init__(
        self,
        urls: Sequence[str],
        key_file: Path | None = None,
        tls_certificate: Path | None = None,
    ) -> None:
        headers = {"Content-Type": "application/json"}
        key = None if key_file is None else KeyFile(key_file)
        # trust_env=False: the client does not reach the coordinator through a proxy of the
        # environment.
        verify = True if tls_certificate is None else pinned(tls_certificate)
        self._http = httpx.Client(headers=headers, auth=key, verify=verify, trust_env=False)
        self._urls = deque(url.rstrip("/") for url in urls)
        """URLs of coordinators with one database. The client asks the first one."""

    def register(self, registration: api.WorkerRegistration) -> api.WorkerSession:
        """Open a session.

        Raises CoordinatorError.
        """
        return self._post("/v1/workers", registration, api.WorkerSession)

    def lease(self, request: api.LeaseRequest) -> api.LeaseBatch:
        """Lease tasks.

        A request whose answer is lost is not repeated: the coordinator takes its tasks back when
        their lease is over.

        Raises CoordinatorError.
        """
        return self._post("/v1/worker/lease", request, api.LeaseBatch, timeout=LONG_TIMEOUT)

    def heartbeat(self, heartbeat: api.Heartbeat) -> api.HeartbeatAnswer:
        """Renew leases.

        Raises CoordinatorError.
        """
        return self._post("/v1/worker/heartbeat", heartbeat, api.HeartbeatAnswer)

    def report(self, reports: api.ReportBatch) -> api.ReportAnswer:
        """Report results.

        Raises CoordinatorError.
        """
        return self._post("/v1/worker/report", reports, api.ReportAnswer, timeout=LONG_TIMEOUT)

    def close(self) -> None:
        self._http.close()

    def _post(
        self,
        path: str,
        document: BaseModel,
        answer: type[Answer],
        *,
        timeout: httpx.Timeout = SHORT_TIMEOUT,
    ) -> Answer:
        url = self._urls[0]
        try:
            response = self._http.post(
                url + path, content=document.model_dump_json(), timeout=timeout
            )
        except httpx.TransportError as error:
            # Ask the next URL, unless another thread has already turned away from this one.
            if self._urls[0] == url:
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
    """Doubles the wait after each failure.

    It has jitter, so that many dispatchers do not return at once.
    """

    def __init__(self, *, first: float = 0.2, most: float = 5.0) -> None:
        self._first = first
        self._most = most
        self._delay = first
        self.next_try = 0.0
        """Earliest time of the next attempt, on the monotonic clock [s]."""

    def failed(self) -> float:
        """Record a failure, double the wait, and return the time until the next attempt [s]."""
        delay = self._delay * random.uniform(0.5, 1.0)
        self._delay = min(2 * self._delay, self._most)
        self.next_try = time.monotonic() + delay
        return delay

    def succeeded(self) -> None:
        """Allow the next attempt at once."""
        self._delay = self._first
        self.next_try = 0.0


class Outbox:
    """The results that wait for a report, by task.

    `LeaseTable` locks it.
    """

    def __init__(self) -> None:
        self._reports: dict[str, api.Report] = {}
        self.report_at = math.inf
        """Latest time of the next report, on the monotonic clock [s].

        It is infinite without a result.
        """

    def put(self, report: api.Report) -> None:
        """Add a report, in place of an older one of the same task."""
        self.report_at = min(self.report_at, time.monotonic() + REPORT_SECONDS)
        self._reports[report.task_id] = report

    def drop(self, task_id: str) -> None:
        """Remove the report of a task, if it exists."""
        self._reports.pop(task_id, None)

    def has_report(self, task_id: str) -> bool:
        """Return whether a report of a task waits."""
        return task_id in self._reports

    def reports(self) -> tuple[api.Report, ...]:
        """Return all waiting reports."""
        return tuple(self._reports.values())


class LeaseTable:
    """The leases that the dispatcher holds, and the outbox of their results.

    It is thread-safe.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._states: dict[str, api.LeaseState] = {}
        self._outbox = Outbox()

    @property
    def report_at(self) -> float:
        """Latest time of the next report, on the monotonic clock [s].

        It is infinite without a result.
        """
        return self._outbox.report_at

    def add(self, leases: Iterable[api.Lease]) -> None:
        """Add leases, in place of older ones of the same tasks."""
        with self._lock:
            for lease in leases:
                self._states[lease.task_id] = api.LeaseState(
                    task_id=lease.task_id, token=lease.token, started=False
                )
                # The coordinator would refuse a result of the older lease as stale.
                self._outbox.drop(lease.task_id)

    def update(self, leases: Iterable[api.Lease], **changes: object) -> None:
        """Record that tasks have `started`, or their `frames`: (frames done, frames total)."""
        with self._lock:
            for lease in leases:
                if self.holds(lease):
                    self._states[lease.task_id] = self._states[lease.task_id].model_copy(
                        update=changes
                    )

    def put_result(self, lease: api.Lease | api.LeaseState, result: TaskResult | None) -> None:
        """Put the result of a held lease, or its return, into the outbox."""
        with self._lock:
            if self.holds(lease):
                self._outbox.put(
                    api.Report(task_id=lease.task_id, token=lease.token, result=result)
                )

    def return_unfinished(self, *, started: bool) -> None:
        """Return the leases without a result.

        Leases of started tasks are returned only if `started` is true.
        """
        for state in self.states():
            is_returned = started or not state.started
            if is_returned and not self._outbox.has_report(state.task_id):
                self.put_result(state, None)

    def remove(self, leases: Iterable[api.Lease | api.LeaseState | api.Report]) -> None:
        """Remove leases, but keep newer ones of the same tasks."""
        with self._lock:
            for lease in leases:
                if self.holds(lease):
                    del self._states[lease.task_id]
                    self._outbox.drop(lease.task_id)

    def remove_reported(self, reports: Iterable[api.Report]) -> None:
        """Remove the leases of reports that the coordinator has answered."""
        self.remove(reports)
        self._outbox.report_at = math.inf

    def holds(self, lease: api.Lease | api.LeaseState | api.Report) -> bool:
        """Return whether the dispatcher holds a lease, and no newer one of its task."""
        state = self._states.get(lease.task_id)
        return state is not None and state.token == lease.token

    def states(self) -> tuple[api.LeaseState, ...]:
        """Return the states of all leases."""
        with self._lock:
            return tuple(self._states.values())

    def reports(self) -> tuple[api.Report, ...]:
        """Return the results that wait for a report."""
        with self._lock:
            return self._outbox.reports()


class Session(threading.Thread):
    """Registers the dispatcher, and renews its leases by heartbeats.

    It sends three heartbeats in the duration of a lease, and more at the start. It is a daemon and
    never keeps the process alive.
    """

    def __init__(
        self, coordinator: CoordinatorClient, registration: Callable[[], api.WorkerRegistration]
    ) -> None:
        super().__init__(name="session", daemon=True)
        self._coordinator = coordinator
        self._registration = registration
        self.leases = LeaseTable()
        self._worker_id = ""
        self._interval = 0.0
        self._requested_sessions = 1
        """Number of sessions requested so far."""
        self._open_session = 0
        """Number of the open session, 0 before the first."""
        self._ended = False
        self._wake = threading.Event()
        self.error: CoordinatorError | None = None
        """Error of a coordinator that refuses this dispatcher."""

    @property
    def worker_id(self) -> str | None:
        """ID of this dispatcher at the coordinator, or None without an open session."""
        if self.error is not None:
            raise self.error
        is_open = self._open_session == self._requested_sessions
        return self._worker_id if is_open else None

    def register_again(self) -> None:
        """Register anew at the next heartbeat.

        The coordinator does not know the session, or the dispatcher has new facts to register.
        """
        self._requested_sessions += 1
        self._wake.set()

    def send_heartbeat(self) -> float:
        """Send one heartbeat, and return the time until the next one [s]."""
        states = self.leases.states()
        condition = self._registration().condition
        message = api.Heartbeat(worker_id=self._worker_id, leases=states, condition=condition)
        dropped = set(self._coordinator.heartbeat(message).drop)
        if dropped:
            log.info("dropping %d tasks", len(dropped))
            self.leases.remove(state for state in states if state.task_id in dropped)
        # People watch a starting worker, so it reports its progress more often.
        if condition.state == "ready":
            return self._interval
        return min(START_BEAT_SECONDS, self._interval)

    def report(self, worker_id: str) -> bool:
        """Send all waiting results, and return whether any waited."""
        reports = self.leases.reports()
        for first in range(0, len(reports), REPORTS_A_REQUEST):
            batch = reports[first : first + REPORTS_A_REQUEST]
            answer = self._coordinator.report(api.ReportBatch(worker_id=worker_id, reports=batch))
            for verdict in answer.verdicts:
                if verdict.verdict == "stale":
                    log.warning(
                        "the report of task %s came too late and was refused", verdict.task_id
                    )
            self.leases.remove(batch)
        self.leases.remove_reported(reports)
        return bool(reports)

    def wake_heartbeat(self) -> None:
        """Send the next heartbeat at once, so that the coordinator learns the condition."""
        self._wake.set()

    def close(self) -> None:
        """End the session: return all leases and send the condition, if the coordinator answers."""
        self.leases.return_unfinished(started=True)
        with contextlib.suppress(CoordinatorError):
            worker_id = self.worker_id
            if worker_id is not None:
                self.report(worker_id)
                self.send_heartbeat()
        self._ended = True
        self._wake.set()
        self.join(LAST_BEAT_SECONDS)  # a heartbeat in progress may end first
        self._coordinator.close()

    def run(self) -> None:
        """Keep the session until `close`."""
        backoff = Backoff()
        while not self._ended:
            try:
                if self._open_session != self._requested_sessions:
                    self._open()
                wait = self.send_heartbeat()
                backoff.succeeded()
            except UnknownWorkerError:
                self.register_again()
                continue
            except UnreachableError as error:
                log.warning("the coordinator is away: %s", error)
                wait = backoff.failed()
            # The dispatcher finds the error in `error`, and `worker_id` raises it.
            except CoordinatorError as error:
                log.exception("the coordinator refuses this dispatcher")
                self.error = error
                return
            self._wake.wait(wait)
            self._wake.clear()

    def _open(self) -> None:
        """Register.

        The leases of an earlier session are lost. The coordinator leases their tasks again.
        """
        # Another thread may request yet another session meanwhile. That session is opened next.
        requested = self._requested_sessions
        session = self._coordinator.register(self._registration())
        self.leases.remove(self.leases.states())
        self._worker_id = session.worker_id
        self._interval = session.lease_seconds / HEARTBEATS_A_LEASE
        self._open_session = requested
        log.info("registered as %s", session.worker_id)
