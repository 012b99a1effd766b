"""The dispatcher: leases tasks from the coordinator, gives them to Ray, and reports results.

One thread does everything but heartbeats. It sleeps in `ray.wait` and never blocks on the coordinator for longer than
one request, so running work goes on while the coordinator is away, and its results wait.
"""

import json
import logging
import math
import os
import subprocess
import time
from typing import Any

from stickslip_schemas.base import Reason, Stage
from stickslip_schemas.documents.tasks import TaskResult
from stickslip_schemas.documents.worker_api import LeaseRequest, WorkerCondition, WorkerRegistration
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.store import open_store

from stickslip_workers.batches import LARGEST_BATCH, Call, Pace
from stickslip_workers.calls import Calls, NotDoneError, StartError
from stickslip_workers.cluster import Place
from stickslip_workers.lease_client import Backoff, CoordinatorClient, Session, UnreachableError
from stickslip_workers.settings import Settings
from stickslip_workers.stages.run import StageActor, failed, failure, with_damaged_inputs

log = logging.getLogger(__name__)

LONGEST_WAIT = 1.0
"""The loop looks at time limits and dropped leases at least so often; it asks so often for what could not start [s]."""


class Dispatcher:
    """See the module. `run` returns when `stop` is called."""

    def __init__(self, settings: Settings, place: Place) -> None:
        self._settings = settings
        self._place = place
        self._began = time.monotonic()
        self._store = open_store(settings.store)
        self._coordinator = CoordinatorClient(settings.urls, settings.key, settings.tls_certificate)
        self._session = Session(self._coordinator, self._registration)
        self._book = self._session.book
        self._backoff = Backoff()
        self._described: dict[bool, dict[str, Any]] = {}
        """What the stages and the renderer say about themselves, with their builds."""
        self._calls: Calls | None = None
        self._waiting: list[Call] = []
        """What Ray has no room for yet, the end of a job before its beginning."""
        self._pace = Pace()
        self._next_lease = 0.0
        self._error = ""
        self.stopping = False

    def stop(self) -> bool:
        """Stop leasing, give back what has not been started, and let `run` return soon.

        Return False where `run` does not look at it, since it waits for Ray.
        """
        self.stopping = True  # no lock: signal handlers call this
        return self._calls is not None

    def run(self) -> None:
        try:
            self._session.start()
            self._described = {False: StageActor(os.devnull).describe(), True: self._describe_renderer()}
            self._session.renew()  # now it can say what it makes
            self._place.connect()
            calls = self._calls = Calls(self._settings, self._described)
            self._session.tell()
            while not self.stopping:
                self._turn(calls)
            self._book.give_back(started=False)
            deadline = time.monotonic() + self._settings.stop_seconds
            while any(one.parts for one in calls) and time.monotonic() < deadline:
                self._turn(calls)
        except Exception as error:
            self._error = f"it has ended: {type(error).__name__}: {error}"
            raise
        finally:
            self._session.close()  # Ray ends what runs when this process is gone

    def _describe_renderer(self) -> dict[str, Any]:
        """Return what the renderer says about itself, in Blender's interpreter."""
        python, (module, name) = self._settings.blender_python, self._settings.render_actor.split(":")
        script = f"import json, os, {module} as made; print(json.dumps(made.{name}(os.devnull).describe()))"
        done = subprocess.run([python, "-c", script], capture_output=True, text=True)
        if done.returncode != 0:
            raise StartError(f"{python} cannot describe its renderer: {done.stderr.strip().rpartition(chr(10))[2]}")
        return dict(json.loads(done.stdout.splitlines()[-1]))

    def _registration(self) -> WorkerRegistration:
        own, rendering = (self._described.get(who, {"builds": {}})["builds"] for who in (False, True))
        calls = None if self._error else self._calls
        waiting = f"waiting for Ray: {time.monotonic() - self._began:.0f} s, {self._place.trouble()}"
        condition = WorkerCondition(
            state="ready" if calls else "starting",
            slots=int(calls.cpus) if calls else 0,
            reason=(calls.trouble if calls else self._error or waiting)[:1000],  # as much as the contract allows
        )
        return WorkerRegistration(
            name=self._settings.name,
            builds={name: Builds(**of, render=rendering[name]) for name, of in own.items() if name in rendering},
            versions={name: value for said in self._described.values() for name, value in said["versions"].items()},
            condition=condition,
        )

    def _turn(self, calls: Calls) -> None:
        self._collect(calls, self._wait_seconds(calls))
        self._enforce_limits(calls)
        self._give_work(calls)
        worker_id = self._session.worker_id
        if worker_id is None or time.monotonic() < self._backoff.next_try:
            return
        try:
            if time.monotonic() >= self._report_time(calls) and self._session.report(worker_id):
                self._next_lease = 0.0  # what has ended may have made new tasks possible
            self._lease(calls, worker_id)
            self._backoff.succeeded()
        except UnreachableError as error:
            log.warning("the coordinator is away, or does not know this worker: %s", error)
            self._backoff.failed()
            self._session.tell()

    def _wait_seconds(self, calls: Calls) -> float:
        """Return how long there is nothing to do unless Ray has news."""
        due = min(self._report_time(calls), self._next_lease if self._wanted(calls) else math.inf)
        wait = max(due, self._backoff.next_try) - time.monotonic()
        return min(max(wait, 0.0 if self._session.worker_id else LONGEST_WAIT / 10), LONGEST_WAIT)

    def _report_time(self, calls: Calls) -> float:
        """Return when to report: at once where the coordinator's next tasks may hang on it."""
        is_busy = self._waiting or any(one.parts and not one.node for one in calls)
        return self._book.due if is_busy or self._book.due == math.inf else 0.0

    def _collect(self, calls: Calls, timeout: float) -> None:
        """Take in what Ray says until nothing is left to take."""
        for one, said in calls.collect(timeout):
            if said is None:
                self._book.note(one.leases, started=True)
            elif isinstance(said, tuple):
                self._book.note(one.leases, frames=said)
            elif isinstance(said, NotDoneError):
                self._waiting.insert(0, Call(one.stage, one.parts, one.is_short))
            elif isinstance(said, Exception) and len(one.parts) > 1:
                log.warning("a call of %d parts failed (%s); each is done again by itself", len(one.parts), said)
                self._waiting[:0] = [Call(one.stage, [part], one.is_short) for part in one.parts]
            else:
                self._settle(one, said)

    def _settle(self, one: Call, said: list[Any] | Exception) -> None:
        """Put the results of a call into the outbox."""
        if isinstance(said, list):
            seconds = time.monotonic() - one.started_at
            results = [r.model_copy(update={"call_seconds": seconds / len(one.parts)}) for r in one.results(said)]
            self._pace.note(one, seconds, results)
        elif one.cancelled:
            results = [failed(Reason.exec_timeout, one.cancelled)] * len(one.leases)
        else:
            result = process_failure(said, renders=one.stage is Stage.render)
            results = [with_damaged_inputs(result, lease.task, self._store) for lease in one.leases]
        for lease, result in zip(one.leases, results, strict=True):
            if result.outcome == "failed":
                log.warning("task %s failed: %s: %s", lease.task_id, result.reason, result.message)
            self._book.settle(lease, result)

    def _enforce_limits(self, calls: Calls) -> None:
        """End what has run too long, and what nobody wants any more."""
        now = time.monotonic()
        for one in calls:
            if one.cancelled or not one.parts:
                continue
            limit = one.limit(self._settings.exec_seconds[one.stage])
            if not any(map(self._book.holds, one.leases)):
                calls.cancel(one, "nobody wants it any more")
            elif now > one.started_at + limit:
                calls.cancel(one, f"not done within {limit:.3g} s; its process on node {one.node[:8]} was ended")

    def _give_work(self, calls: Calls) -> None:
        """Give Ray what waits, as far as there is room; one short call goes beside long ones."""
        self._waiting = [one for one in self._waiting if any(map(self._book.holds, one.leases)) and not self.stopping]
        for one in list(self._waiting):
            one.is_express = self._is_short(one) and calls.is_clogged() and not any(other.is_express for other in calls)
            if one.is_express or calls.room() > 0:
                self._waiting.remove(one)
                calls.give(one)

    def _is_short(self, one: Call) -> bool:
        return one.is_short or self._pace.call(one.stage) < self._settings.clog_seconds

    def _lease(self, calls: Calls, worker_id: str) -> None:
        """Ask for work if some is wanted and it is time."""
        wanted = self._wanted(calls)
        if not wanted or time.monotonic() < self._next_lease:
            return
        at_most = self._settings.clog_seconds if calls.is_clogged() else None
        batch = self._coordinator.lease(LeaseRequest(worker_id=worker_id, wanted=wanted, at_most_seconds=at_most))
        wait = batch.retry_after_seconds if at_most is None and calls.room() > 0 else LONGEST_WAIT
        self._next_lease = time.monotonic() + wait
        self._book.add(batch.leases)
        self._waiting += self._pace.calls(batch.leases, is_short=at_most is not None)
        self._waiting.sort(key=lambda one: -list(Stage).index(one.stage))
        self._give_work(calls)

    def _wanted(self, calls: Calls) -> dict[Stage, int]:
        """Return how many tasks to ask for: little more than what can run, so that a kill gives little back."""
        if self.stopping:
            return {}
        if calls.is_clogged():
            if any(one.is_express for one in calls) or any(map(self._is_short, self._waiting)):
                return {}
            return {stage: LARGEST_BATCH if stage is Stage.simulate else 1 for stage in Stage}
        room, wanted = max(calls.room(), 0), {}  # where there is room, nothing waits
        for stage in Stage:
            ahead = int(calls.cpus * self._pace.ahead(stage))
            missing = room + ahead - sum(one.stage is stage for one in self._waiting)
            if missing > ahead / 2:  # not for one at a time
                wanted[stage] = min(missing * self._pace.tasks(stage), LARGEST_BATCH)
        return wanted


def process_failure(error: Exception, *, renders: bool) -> TaskResult:
    """Return the result of a task of Ray that raised `error`, or whose process or node died."""
    from ray import exceptions as ray_errors

    if isinstance(error, ray_errors.RayTaskError):
        # What was raised in the process; Ray leaves the traceback when the exception itself cannot travel.
        return failure(error.cause) if isinstance(error.cause, Exception) else failed(Reason.internal_error, str(error))
    if isinstance(error, ray_errors.OutOfMemoryError):
        return failed(Reason.oom_killed, str(error))
    if isinstance(error, ray_errors.WorkerCrashedError):
        return failed(Reason.renderer_crash if renders else Reason.process_crash, str(error))
    return failed(Reason.worker_lost, str(error))
