"""The client of the worker API: requests and the back-off between them, the leases held, and their heartbeat."""

import logging
import random
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import Literal, TypeVar

import httpx
from pydantic import BaseModel
from stickslip_schemas.documents.problems import ProblemCode
from stickslip_schemas.documents.tasks import TaskResult
from stickslip_schemas.documents.worker_api import (
    Heartbeat,
    HeartbeatAnswer,
    Lease,
    LeaseBatch,
    LeaseRequest,
    LeaseState,
    Report,
    ReportAnswer,
    ReportBatch,
    WorkerCondition,
    WorkerRegistration,
    WorkerSession,
)

log = logging.getLogger(__name__)

Answer = TypeVar("Answer", bound=BaseModel)

PROMPT = httpx.Timeout(30, connect=5)
PATIENT = httpx.Timeout(300, connect=5)
"""Timeout of a lease and a report: for a version of a million samples, the coordinator lists or checks all files."""

REPORTS_A_REQUEST = 512

REPORT_SECONDS = 1.0
"""How long a result waits for others to be reported with, while there is other work to go on with."""

START_BEAT_SECONDS = 2.0
"""Time between two heartbeats of a dispatcher that starts, which tell how far it is [s]."""

REASON_LENGTH = 1000
"""Limit of the reason of a state [characters]."""

LAST_BEAT_SECONDS = 5.0
"""Time limit of a heartbeat in progress when the thread is stopped."""


class CoordinatorError(Exception):
    """A request to the coordinator failed."""


class UnreachableError(CoordinatorError):
    """No answer, or an answer that asks for another attempt later."""


class UnknownWorkerError(CoordinatorError):
    """The coordinator does not know the session: register again."""


class SupersededError(CoordinatorError):
    """A newer dispatcher has registered under the same name; this one must end."""


class RefusedError(CoordinatorError):
    """A request that would fail every time."""


def pinned(certificate: Path) -> ssl.SSLContext:
    """Return a context that trusts a server with this certificate, under any host name."""
    context = ssl.create_default_context(cafile=str(certificate))
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    context.check_hostname = False
    return context


class CoordinatorClient:
    """Client of the worker API. Thread-safe."""

    def __init__(self, urls: Sequence[str], key: str | None = None, tls_certificate: Path | None = None) -> None:
        # trust_env=False: the coordinator is not reached through a proxy of the environment.
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        verify = True if tls_certificate is None else pinned(tls_certificate)
        self._http = httpx.Client(headers=headers, verify=verify, trust_env=False)
        self._urls = deque(url.rstrip("/") for url in urls)
        """Of coordinators with one database; the first one is asked."""

    def register(self, registration: WorkerRegistration) -> WorkerSession:
        return self._post("/v1/workers", registration, WorkerSession)

    def lease(self, request: LeaseRequest) -> LeaseBatch:
        """Ask for tasks."""
        return self._post("/v1/worker/lease", request, LeaseBatch, timeout=PATIENT)

    def heartbeat(self, heartbeat: Heartbeat) -> HeartbeatAnswer:
        """Renew leases."""
        return self._post("/v1/worker/heartbeat", heartbeat, HeartbeatAnswer)

    def report(self, reports: ReportBatch) -> ReportAnswer:
        return self._post("/v1/worker/report", reports, ReportAnswer, timeout=PATIENT)

    def close(self) -> None:
        self._http.close()

    def _post(self, path: str, document: BaseModel, answer: type[Answer], *, timeout: httpx.Timeout = PROMPT) -> Answer:
        url = self._urls[0]
        try:
            response = self._http.post(
                url + path,
                content=document.model_dump_json(),
                headers={"Content-Type": "application/json"},
                timeout=timeout,
            )
        except httpx.TransportError as error:
            self._turn_from(url)
            raise UnreachableError(f"{url}{path}: {type(error).__name__}: {error}") from error
        if response.status_code >= 500 or response.status_code == 429:
            raise UnreachableError(f"{path}: {response.status_code} {response.text[:500]}")
        if response.is_success:
            return answer.model_validate_json(response.content)
        kind = _ERRORS.get(_problem_code(response), RefusedError)
        raise kind(f"{path}: {response.status_code} {response.text[:500]}")

    def _turn_from(self, url: str) -> None:
        """Ask the next coordinator from now on, unless another thread has turned from this one already."""
        if self._urls[0] == url:
            self._urls.rotate(-1)


_ERRORS: dict[str | None, type[CoordinatorError]] = {
    ProblemCode.unknown_worker: UnknownWorkerError,
    ProblemCode.conflict: SupersededError,
}


def _problem_code(response: httpx.Response) -> str | None:
    try:
        return str(response.json()["code"])
    except (ValueError, KeyError, TypeError):
        return None


class Backoff:
    """Doubles the wait after each failure, with jitter so that many dispatchers do not return at once."""

    def __init__(self, *, first: float = 0.2, most: float = 5.0) -> None:
        self._first = first
        self._most = most
        self.failures = 0
        self.next_try = 0.0
        """Earliest time of the next attempt, on the monotonic clock [s]."""

    def failed(self) -> None:
        """Note a failure and double the wait."""
        delay = min(self._most, self._first * 2.0 ** min(self.failures, 16))
        self.failures += 1
        self.next_try = time.monotonic() + delay * random.uniform(0.5, 1.0)

    def succeeded(self) -> None:
        """Reset the wait."""
        self.failures = 0
        self.next_try = 0.0


class LeaseBook:
    """The leases that the dispatcher holds, shared between its loop and its heartbeat. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._states: dict[str, LeaseState] = {}

    def add(self, leases: Iterable[Lease]) -> None:
        self._put(leases, started=False)

    def start(self, leases: Iterable[Lease]) -> None:
        """Mark the tasks as started."""
        self._put(leases, started=True)

    def _put(self, leases: Iterable[Lease], *, started: bool) -> None:
        with self._lock:
            for lease in leases:
                self._states[lease.task_id] = LeaseState(task_id=lease.task_id, token=lease.token, started=started)

    def note_frames(self, lease: Lease, frames: tuple[int, int]) -> None:
        """Set the progress of a started task: (frames done, frames total)."""
        with self._lock:
            if self._has(lease.task_id, lease.token):
                state = self._states[lease.task_id]
                self._states[lease.task_id] = state.model_copy(update={"frames": frames})

    def remove(self, task_id: str, token: int | None) -> None:
        """Remove a lease; a newer one of the same task stays."""
        with self._lock:
            if self._has(task_id, token):
                del self._states[task_id]

    def holds(self, lease: Lease) -> bool:
        """Return whether the lease is still held."""
        with self._lock:
            return self._has(lease.task_id, lease.token)

    def _has(self, task_id: str, token: int | None) -> bool:
        state = self._states.get(task_id)
        return state is not None and state.token == token

    def drop(self, task_ids: Iterable[str], *, as_of: Iterable[LeaseState]) -> None:
        """Remove the tasks that the answer to a heartbeat with the states `as_of` names.

        A lease granted since then stays.
        """
        tokens = {state.task_id: state.token for state in as_of}
        for task_id in task_ids:
            self.remove(task_id, tokens.get(task_id))

    def clear(self) -> None:
        """Remove all leases, at the end of a session."""
        with self._lock:
            self._states.clear()

    def states(self) -> tuple[LeaseState, ...]:
        with self._lock:
            return tuple(self._states.values())


class Outbox:
    """Results that wait to be reported."""

    def __init__(self, coordinator: CoordinatorClient, book: LeaseBook) -> None:
        self._coordinator = coordinator
        self._book = book
        self._reports: deque[Report] = deque()
        self.due = 0.0
        """When to report them at the latest."""

    def __len__(self) -> int:
        return len(self._reports)

    def add(self, lease: Lease, result: TaskResult | None) -> None:
        """Add a result, or the return of a lease, unless it is not held any more."""
        if self._book.holds(lease):
            if not self._reports:
                self.due = time.monotonic() + REPORT_SECONDS
            self._reports.append(Report(task_id=lease.task_id, token=lease.token, result=result))

    def clear(self) -> None:
        """Forget all, at the end of a session."""
        self._reports.clear()

    def send(self, worker_id: str) -> bool:
        """Send all; return whether there were any."""
        there_were = bool(self._reports)
        while self._reports:
            batch = tuple(islice(self._reports, REPORTS_A_REQUEST))
            answer = self._coordinator.report(ReportBatch(worker_id=worker_id, reports=batch))
            for report, verdict in zip(batch, answer.verdicts, strict=True):
                self._reports.popleft()
                self._book.remove(report.task_id, report.token)
                if verdict.verdict == "stale":
                    log.warning("the report of task %s came too late and was refused", report.task_id)
        return there_were


class Status:
    """How the dispatcher is, which its heartbeats tell. It starts as `starting`."""

    def __init__(self, reason: Callable[[], str]) -> None:
        self.state: Literal["starting", "ready"] = "starting"
        self.slots = 0
        self.reason = reason
        """Returns why it is not ready, or what is wrong with its cluster."""

    def condition(self) -> WorkerCondition:
        """Return what to tell the coordinator."""
        return WorkerCondition(state=self.state, slots=self.slots, reason=self.reason()[:REASON_LENGTH])


class HeartbeatThread(threading.Thread):
    """Renews leases from a thread of its own, three times in the duration of a lease, and more often at the start.

    It is a daemon and never keeps the process alive.
    """

    def __init__(self, coordinator: CoordinatorClient, session: WorkerSession, book: LeaseBook, status: Status) -> None:
        super().__init__(name="heartbeat", daemon=True)
        self._coordinator = coordinator
        self._session = session
        self._book = book
        self._status = status
        self.worker_id = session.worker_id
        self._ended = threading.Event()
        self.session_lost = threading.Event()
        """Set when the coordinator no longer knows the session; the thread then ends."""

    def beat(self) -> None:
        """Send one heartbeat."""
        states = self._book.states()
        answer = self._coordinator.heartbeat(
            Heartbeat(worker_id=self.worker_id, leases=states, condition=self._status.condition())
        )
        if answer.drop:
            log.info("dropping %d tasks", len(answer.drop))
            self._book.drop(answer.drop, as_of=states)

    def stop(self) -> None:
        """Stop; a heartbeat in progress may end first, because its connection is about to be closed."""
        self._ended.set()
        self.join(LAST_BEAT_SECONDS)

    def run(self) -> None:
        """Send heartbeats until `stop`."""
        interval = self._session.lease_seconds / 3
        wait = min(START_BEAT_SECONDS, interval)
        while not self._ended.wait(wait):
            wait = interval if self._status.state == "ready" else min(START_BEAT_SECONDS, interval)
            try:
                self.beat()
            except UnknownWorkerError:
                self.session_lost.set()
                return
            except CoordinatorError as error:
                log.warning("no heartbeat: %s", error)
                wait = min(1.0, interval)  # the lease runs out: a failed heartbeat is repeated
