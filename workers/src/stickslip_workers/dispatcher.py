"""The dispatcher: leases tasks from the coordinator, gives them to Ray, and reports results.

One thread does everything but heartbeats. It sleeps in `ray.wait` and never blocks on the coordinator for longer than
one request, so running work goes on while the coordinator is away, and its results wait.
"""

import contextlib
import logging
import time
from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future
from typing import Any

from stickslip_schemas.base.states import Reason, Stage
from stickslip_schemas.documents.tasks import RenderTask, TaskResult
from stickslip_schemas.documents.worker_api import Lease, LeaseRequest, WorkerRegistration
from stickslip_schemas.store import open_store

from stickslip_workers.batches import LARGEST_BATCH, Pace, results_of
from stickslip_workers.calls import Call, Calls, NotDoneError
from stickslip_workers.cluster import Place
from stickslip_workers.lease_client import (
    Backoff,
    CoordinatorClient,
    CoordinatorError,
    HeartbeatThread,
    LeaseBook,
    Outbox,
    Status,
    UnknownWorkerError,
    UnreachableError,
)
from stickslip_workers.results import failed, process_failure, shading_of
from stickslip_workers.settings import Settings
from stickslip_workers.stages.run import with_damaged_inputs
from stickslip_workers.starting import common_builds, find_builds, in_thread

log = logging.getLogger(__name__)

LONGEST_WAIT = 1.0
"""The loop looks at time limits and dropped leases at least so often [s]."""

EXPRESS_POLL_SECONDS = 1.0
"""Time between two questions for short tasks [s]."""

WARM_UP_SECONDS = 10.0
"""The first call of a process says how long others take only where it took longer [s]."""


class Dispatcher:
    """See the module. `run` returns when `stop` is called."""

    def __init__(self, settings: Settings, place: Place) -> None:
        self._settings = settings
        self._place = place
        self._store = open_store(settings.store)
        self._coordinator = CoordinatorClient(settings.urls, settings.key, settings.tls_certificate)
        self._status = Status(lambda: "it looks for its builds")
        self._described: dict[bool, dict[str, Any]] = {}
        """What the stages and the renderer say about themselves, with their builds."""
        self._backoff = Backoff()
        self._heartbeat: HeartbeatThread | None = None
        """Of the session, if one is open."""
        self._book = LeaseBook()
        self._queues: dict[Stage, deque[Lease]] = {stage: deque() for stage in Stage}
        self._short: deque[Lease] = deque()
        """What was leased because it is short, while all CPUs have been taken for long."""
        self._calls: Calls | None = None
        self._pace = Pace()
        self._outbox = Outbox(self._coordinator, self._book)
        self._alone: set[str] = set()
        """Tasks that were in a call that failed: they are not put together with others again."""
        self._next_lease = 0.0
        self._stopping = False

    def stop(self) -> None:
        """Stop leasing, give back what has not been started, and let `run` return soon."""
        self._stopping = True  # no lock: signal handlers call this

    def run(self) -> None:
        """Work until stopped."""
        try:
            begin, connected = time.monotonic(), in_thread(self._place.connect)
            self._status.reason = lambda: f"waiting for Ray: {time.monotonic() - begin:.0f} s, {self._place.trouble()}"
            self._described = self._await(in_thread(lambda: find_builds(self._settings))) or {}
            if self._heartbeat is not None:
                self._heartbeat.session_lost.set()  # now it can say what it makes
            self._await(connected)
            builds = {who: said["builds"] for who, said in self._described.items()}
            if not self._stopping:
                calls = self._calls = self._await(in_thread(lambda: Calls(self._settings, builds)))
            if not self._stopping:
                self._status.state, self._status.reason = "ready", calls.trouble
                self._status.slots = int(calls.cpus)
                self._tell()
            while not self._stopping:
                self._turn(calls)
            self._finish_running()
        except Exception as error:
            why = f"it has ended: {type(error).__name__}: {error}"
            self._status.state, self._status.slots, self._status.reason = "starting", 0, lambda: why
            self._tell()
            raise
        finally:
            self._give_back()

    # --- the start ------------------------------------------------------------------------------------------

    def _await(self, done: "Future[Any]") -> Any:
        """Keep the session until something is done; return what it gave."""
        while not (self._stopping or done.done()):
            self._keep_session()
            time.sleep(0.05)
        return done.result() if done.done() else None

    def _keep_session(self) -> bool:
        """Register where there is no session; return whether there is one now."""
        if time.monotonic() < self._backoff.next_try:
            return False
        try:
            if self._heartbeat is None or self._heartbeat.session_lost.is_set():
                self._open_session()
        except UnreachableError as error:
            self._go_on_without(error)
        return self._heartbeat is not None

    def _tell(self) -> None:
        """Tell the coordinator at once how this dispatcher is."""
        if self._heartbeat is not None:
            with contextlib.suppress(CoordinatorError):
                self._heartbeat.beat()

    # --- one turn of the loop -------------------------------------------------------------------------------

    def _turn(self, calls: Calls) -> None:
        self._collect(calls, self._wait_seconds(calls))
        self._status.slots = int(calls.cpus)
        self._enforce_limits(calls)
        self._give_work(calls)
        if not self._keep_session():
            return
        try:
            if time.monotonic() >= self._report_time() and self._outbox.send(self._worker_id()):
                self._next_lease = 0.0  # what has ended may have made new tasks possible
            if self._lease(calls):
                self._give_work(calls)
            if self._backoff.failures:
                log.info("the coordinator is back")
            self._backoff.succeeded()
        except UnknownWorkerError:
            assert self._heartbeat is not None
            self._heartbeat.session_lost.set()
        except UnreachableError as error:
            self._go_on_without(error)

    def _go_on_without(self, error: UnreachableError) -> None:
        if self._backoff.failures == 0:
            log.warning("the coordinator is away: %s", error)
        self._backoff.failed()

    def _wait_seconds(self, calls: Calls) -> float:
        """Return how long there is nothing to do unless Ray has news."""
        due = [time.monotonic() + LONGEST_WAIT]
        if self._outbox:
            due.append(max(self._report_time(), self._backoff.next_try))
        if self._wanted(calls):
            due.append(max(self._next_lease, self._backoff.next_try))
        return max(min(due) - time.monotonic(), 0.0)

    def _report_time(self) -> float:
        """Return when to report: at once where the coordinator's next tasks may hang on it."""
        return self._outbox.due if any(self._queues.values()) else 0.0

    def _collect(self, calls: Calls, timeout: float) -> None:
        """Take in what Ray says until nothing is left to take."""
        for one, said in calls.collect(timeout):
            if said is None:
                self._book.start(one.leases)
            elif isinstance(said, tuple):
                self._book.note_frames(one.leases[0], said)
            elif isinstance(said, list):
                self._take_in(one, said)
            elif isinstance(said, NotDoneError):
                self._queues[one.stage].extendleft(reversed(one.leases))
            else:
                self._take_failure(one, said)

    def _take_in(self, one: Call, answers: list[Any]) -> None:
        seconds = time.monotonic() - (one.started_at or time.monotonic())
        self._pace.note(one.stage, one.parts, seconds)
        each = seconds / len(one.parts) if not one.is_first or seconds > WARM_UP_SECONDS else None
        results = [r for answer, part in zip(answers, one.parts, strict=True) for r in results_of(answer, part)]
        self._settle(one, [result.model_copy(update={"call_seconds": each}) for result in results])

    def _take_failure(self, one: Call, error: Exception) -> None:
        """Report a failure, but do the parts of a call again, one by one, to see which of them failed."""
        if len(one.parts) > 1:
            log.warning("a call for %s failed (%s); each is done again by itself", _names(one), one.cancelled or error)
            self._alone.update(lease.task_id for lease in one.leases)
            self._queues[one.stage].extendleft(lease for lease in reversed(one.leases) if self._book.holds(lease))
            return None
        if one.cancelled:
            return self._settle(one, [failed(Reason.exec_timeout, one.cancelled)] * len(one.leases))
        result = process_failure(error, renders=one.stage is Stage.render)
        return self._settle(one, [with_damaged_inputs(result, lease.task, self._store) for lease in one.leases])

    def _settle(self, one: Call, results: list[TaskResult]) -> None:
        for lease, result in zip(one.leases, results, strict=True):
            if result.outcome == "failed":
                log.warning("task %s failed: %s: %s", lease.task_id, result.reason, result.message)
            self._alone.discard(lease.task_id)
            self._outbox.add(lease, result)

    def _enforce_limits(self, calls: Calls) -> None:
        """End what has run too long, and what nobody wants any more."""
        now = time.monotonic()
        for one in calls:
            if one.cancelled or not one.parts:
                continue
            if not any(self._book.holds(lease) for lease in one.leases):
                # Most work ends by itself sooner than a new process would start.
                one.unwanted_since = one.unwanted_since or now
                if one.started_at is None or now > one.unwanted_since + self._settings.drop_seconds:
                    calls.cancel(one, "nobody wants it any more")
            elif one.runs_longer_than(one.limit):
                calls.cancel(one, f"not done within {one.limit:.3g} s; its process on node {one.node[:8]} was ended")

    # --- work -----------------------------------------------------------------------------------------------

    def _give_work(self, calls: Calls) -> None:
        """Give Ray what is queued, as far as there is room; one short call goes beside long ones."""
        for queue in (self._short, *self._queues.values()):
            wanted = [lease for lease in queue if self._book.holds(lease)]
            if len(wanted) < len(queue):
                queue.clear()
                queue.extend(wanted)
        for stage in self._pace.order():
            while self._queues[stage] and calls.room(is_long=self._pace.is_long()) > 0:
                calls.give(self._pace.next_parts(self._queues[stage], self._alone), stage)
        if (short := self._express(calls)) and not any(one.is_express and one.parts for one in calls):
            stage = Stage(short[0].task.stage)
            calls.give(self._pace.next_parts(short, self._alone), stage, is_express=True)

    def _express(self, calls: Calls) -> deque[Lease] | None:
        """Return a queue of short tasks, if all CPUs have been taken for long."""
        if self._short or not calls.is_clogged():
            return self._short
        short = (stage for stage in self._pace.order() if (self._pace.part(stage) or 1e9) < self._settings.clog_seconds)
        return next((self._queues[stage] for stage in short if self._queues[stage]), None)

    # --- the coordinator ------------------------------------------------------------------------------------

    def _open_session(self) -> None:
        """Register. What was leased in an earlier session is lost; the coordinator gives it out again."""
        if self._heartbeat is not None:
            self._heartbeat.stop()
            self._heartbeat = None
        self._book.clear()
        self._outbox.clear()
        registration = WorkerRegistration(
            name=self._settings.name,
            builds=common_builds(self._described),
            versions={name: value for said in self._described.values() for name, value in said["versions"].items()},
            condition=self._status.condition(),
        )
        session = self._coordinator.register(registration)
        self._next_lease = 0.0
        self._heartbeat = HeartbeatThread(self._coordinator, session, self._book, self._status)
        self._heartbeat.start()
        log.info("registered as %s", session.worker_id)

    def _worker_id(self) -> str:
        assert self._heartbeat is not None
        return self._heartbeat.worker_id

    def _lease(self, calls: Calls) -> bool:
        """Ask for work if some is wanted and it is time; return whether there was any."""
        wanted = self._wanted(calls)
        if not wanted or time.monotonic() < self._next_lease:
            return False
        clogged = calls.is_clogged()
        at_most = self._settings.clog_seconds if clogged else None
        request = LeaseRequest(worker_id=self._worker_id(), wanted=wanted, at_most_seconds=at_most)
        batch = self._coordinator.lease(request)
        self._next_lease = time.monotonic() + max(batch.retry_after_seconds, EXPRESS_POLL_SECONDS if clogged else 0.0)
        self._book.add(batch.leases)
        for lease in batch.leases:
            (self._short if clogged else self._queues[Stage(lease.task.stage)]).append(lease)
            if isinstance(lease.task, RenderTask):
                self._pace.renders_share = shading_of(lease.task) is not None
        return bool(batch.leases)

    def _wanted(self, calls: Calls) -> dict[Stage, int]:
        """Return how many tasks to ask for: little more than what can run, so that a kill gives little back."""
        pace = self._pace
        if calls.is_clogged():
            is_free = not (self._express(calls) or any(one.is_express and one.parts for one in calls))
            return {stage: LARGEST_BATCH if stage is Stage.simulate else 1 for stage in Stage} if is_free else {}
        queued = sum(pace.calls(stage, queue) for stage, queue in self._queues.items())
        room = max(calls.room(is_long=pace.is_long()), 0)
        wanted = {}
        for stage in Stage:
            ahead = int(calls.cpus * pace.ahead(stage))
            many = ahead + room if room > queued or queued <= ahead // 2 else 0  # not for one at a time
            if many > 0 and not (stage is Stage.simulate and self._queues[stage]):
                wanted[stage] = pace.wanted(stage, many)
        return wanted

    # --- the end --------------------------------------------------------------------------------------------

    def _finish_running(self) -> None:
        """Give running work a moment to end; the rest goes back at once."""
        deadline = time.monotonic() + self._settings.stop_seconds
        if self._calls is None:
            return
        for one in self._calls:
            if one.started_at is None:
                self._calls.forget(one)
                self._release(one.leases)
        self._release_queued()
        while any(one.parts for one in self._calls) and time.monotonic() < deadline:
            self._collect(self._calls, min(LONGEST_WAIT, deadline - time.monotonic()))
            self._try_to_report()

    def _give_back(self) -> None:
        """Give all leases back, if the coordinator listens. Ray ends what runs when this process is gone."""
        calls = self._calls
        for one in calls or ():
            with contextlib.suppress(Exception):  # Ray may be gone
                calls.forget(one)  # type: ignore[union-attr]
            self._release(one.leases)
        self._release_queued()
        for _ in range(3):
            if self._try_to_report():
                break
            time.sleep(0.3)
        if self._heartbeat is not None:
            self._heartbeat.stop()
        self._coordinator.close()

    def _release_queued(self) -> None:
        for queue in (self._short, *self._queues.values()):
            self._release(queue)
            queue.clear()

    def _release(self, leases: Iterable[Lease]) -> None:
        for lease in leases:
            self._outbox.add(lease, None)

    def _try_to_report(self) -> bool:
        try:
            return self._heartbeat is None or self._outbox.send(self._worker_id()) in (True, False)
        except CoordinatorError as error:
            log.warning("could not report: %s", error)
            return False


def _names(one: Call) -> str:
    leases = one.leases
    return leases[0].task_id if len(leases) == 1 else f"{leases[0].task_id} and {len(leases) - 1} more"
