"""The dispatcher: leases tasks from the coordinator, keeps the processes of a Ray cluster busy, reports results.

One thread does everything but heartbeats. It sleeps in `ray.wait` and never blocks on the coordinator for longer than
one request, so running work goes on while the coordinator is away, and its results wait.
"""

import contextlib
import logging
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain, islice
from typing import Any

from pydantic import TypeAdapter, ValidationError
from stickslip_schemas import tracing
from stickslip_schemas.base.states import Reason, Stage
from stickslip_schemas.documents.tasks import RenderTask, SimulateTask, Task, TaskResult
from stickslip_schemas.documents.worker_api import (
    Lease,
    LeaseRequest,
    Report,
    ReportBatch,
    WorkerRegistration,
    WorkerSession,
)
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.store import open_store

from stickslip_workers.cluster import Cluster, ClusterLostError
from stickslip_workers.kinds import kind, kind_names
from stickslip_workers.lease_client import (
    Backoff,
    CoordinatorClient,
    CoordinatorError,
    HeartbeatThread,
    LeaseBook,
    UnknownWorkerError,
    UnreachableError,
)
from stickslip_workers.processes import Pool, PoolSettings, Process
from stickslip_workers.results import failed, failure, merged, process_failure, shading_of, split
from stickslip_workers.settings import CPU, RENDER_DEVICE, Settings
from stickslip_workers.stages.run import AnyTask, with_damaged_inputs

log = logging.getLogger(__name__)

LONGEST_WAIT = 1.0
"""The loop looks at time limits and dropped leases at least so often [s]."""

REPORTS_A_REQUEST = 512

EXPRESS_SLOTS = 1
"""Calls beyond `slots` that may run while all of these have been taken for long: short tasks do not wait for hours."""

EXPRESS_POLL_SECONDS = 1.0
"""Time between two questions for short tasks [s]."""

FRAMES_SECONDS = 2.0
"""Time between two questions to a simulation how far it is [s]."""

WARM_UP_SECONDS = 10.0
"""The first call of a process is gone by only where it took longer [s]."""

REPORT_SECONDS = 1.0
"""How long a result waits for others to be reported with, while there is other work to go on with."""

AHEAD_SECONDS = 2.0
MOST_AHEAD = 16
"""Calls that wait here, for each slot: enough for so long, but one at least and not more than so many. A request costs
the coordinator about 10 ms whatever it asks for."""

RENDERS_TOGETHER = 12
"""Renders of one shading that one call makes at most; so many are leased ahead, for they cost little more than one."""

SHORT_SECONDS = 0.5
"""Renders that share no shading are given to a process several at once, if they take so long together [s]: a call costs
the dispatcher, Ray and the process some milliseconds."""

LARGEST_BATCH = max(kind(name).batch for name in kind_names())
"""How many simulations to ask for at once: one call takes them all."""

_PRECEDENCE = (Stage.publish, Stage.pack, Stage.simulate, Stage.render)
"""What goes first: the end of a job before its beginning, and simulations, while they are short, before renders."""

LONG_SIMULATION = 2.0
"""Simulations that take longer [s] go after renders: clips come out while others are simulated, and the time left
is known for both. Of such no more are leased than run soon, for another dispatcher may have nothing to do."""

_tasks: TypeAdapter[list[AnyTask]] = TypeAdapter(list[Task])
_results = TypeAdapter(list[TaskResult])


@dataclass(eq=False)
class Assignment:
    """Work that a process is at: one task, a batch of simulations, or renders."""

    parts: list[list[Lease]]
    """Tasks that have one answer together: all simulations, or renders of one shading."""
    stage: Stage
    process: Process
    started_at: float
    limit: float
    """It is ended after this time [s]."""
    asked: Any = None
    """Ray's reference to the frames that are done, while the process has not answered."""
    asked_at: float = 0.0
    unwanted_since: float | None = None

    @property
    def leases(self) -> list[Lease]:
        """All tasks."""
        return list(chain.from_iterable(self.parts))


class Dispatcher:
    """See the module. `run` returns when `stop` is called; Ray must be connected."""

    def __init__(self, settings: Settings, cluster: Cluster) -> None:
        self._settings = settings
        self._cluster = cluster
        self._slots = settings.slots or cluster.cpus
        most = self._slots + EXPRESS_SLOTS
        # Both pools full take all CPUs of the cluster, so that neither can keep the other from starting.
        share = int(0.5 * max(cluster.cpus, 1) / most * 1000) / 1000
        common: dict[str, Any] = {
            "store": settings.store,
            "size": most,
            "num_cpus": share,
            "start_seconds": settings.start_seconds,
            "process_bytes": settings.process_bytes,
            "environment": {RENDER_DEVICE: settings.render_device},
        }
        self._stage_pool = Pool(
            PoolSettings(
                sort="stage",
                factory="stickslip_workers.stages.run:StageActor",
                tasks_per_process=10_000,
                tells_frames=True,
                **common,
            )
        )
        self._render_pool = Pool(
            PoolSettings(
                sort="render",
                factory=settings.render_actor,
                tasks_per_process=settings.renders_per_process,
                python=str(settings.blender_python),
                num_gpus=0 if settings.render_device == CPU else 1,
                **common,
            )
        )
        self._store = open_store(settings.store)
        self._coordinator = CoordinatorClient(settings.url, settings.key, settings.tls_certificate)
        self._backoff = Backoff()
        self._session: WorkerSession | None = None
        self._heartbeat: HeartbeatThread | None = None
        self._book = LeaseBook()
        self._queues: dict[Stage, deque[Lease]] = {stage: deque() for stage in _PRECEDENCE}
        self._running: dict[Any, Assignment] = {}
        self._reports: deque[Report] = deque()
        self._reports_due = 0.0
        self._part_seconds: dict[Stage, float] = {}
        """How long one part of a call takes, lately."""
        self._simulation_seconds: float | None = None
        self._alone: set[str] = set()
        """Tasks that were in a call that failed: they are not put together with others again."""
        self._renders_share = False
        """Whether the last renders that were leased share shadings."""
        self._next_lease = 0.0
        self._was_clogged = False
        self._stopping = False

    def stop(self) -> None:
        """Stop leasing, give back what has not been started, and let `run` return soon."""
        self._stopping = True  # no lock: signal handlers call this

    def run(self) -> None:
        """Work until stopped."""
        try:
            self._find_builds()
            # Blender takes seconds to start: the first job should not have to wait for it.
            self._render_pool.grow(self._slots)
            while not self._stopping:
                self._turn()
            self._finish_running()
        finally:
            self._give_back()

    # --- one turn of the loop -------------------------------------------------------------------------------

    def _turn(self) -> None:
        self._collect(self._wait_seconds())
        if self._cluster.lost:
            raise ClusterLostError(f"{self._cluster.lost} is gone")
        self._stage_pool.check_starts()
        self._render_pool.check_starts()
        self._enforce_limits()
        self._ask_for_frames()
        if self._is_clogged():
            self._hand_back()
        self._start_work()
        if time.monotonic() < self._backoff.next_try:
            return
        try:
            if self._session is None or (self._heartbeat is not None and self._heartbeat.session_lost.is_set()):
                self._open_session()
            if time.monotonic() >= self._report_time() and self._report():
                self._next_lease = 0.0  # what has ended may have made new tasks possible
            if self._lease():
                self._start_work()
            if self._backoff.failures:
                log.info("the coordinator is back")
            self._backoff.succeeded()
        except UnknownWorkerError:
            if self._heartbeat is not None:
                self._heartbeat.session_lost.set()
        except UnreachableError as error:
            if self._backoff.failures == 0:
                log.warning("the coordinator is away: %s", error)
            self._backoff.failed()

    def _wait_seconds(self) -> float:
        """Return how long there is nothing to do unless work ends or a process starts."""
        due = [time.monotonic() + LONGEST_WAIT]
        if self._session is None:
            due.append(self._backoff.next_try)
        if self._reports:
            due.append(max(self._report_time(), self._backoff.next_try))
        if self._wanted():
            due.append(max(self._next_lease, self._backoff.next_try))
        return max(min(due) - time.monotonic(), 0.0)

    def _report_time(self) -> float:
        """Return when to report: at once where the coordinator's next tasks may hang on it."""
        return self._reports_due if any(self._queues.values()) else 0.0

    def _collect(self, timeout: float) -> None:
        """Wait until something ends, and take in what has."""
        import ray

        refs = list(self._running)
        if not self._stopping:
            refs += [*self._stage_pool.waiting_refs(), *self._render_pool.waiting_refs()]
        if not refs:
            time.sleep(timeout)
            return
        ray.wait(refs, num_returns=1, timeout=timeout)
        if not self._running:
            return
        ended, _ = ray.wait(list(self._running), num_returns=len(self._running), timeout=0)
        for ref in ended:
            self._take_in(ref, self._running.pop(ref))

    def _take_in(self, ref: Any, assignment: Assignment) -> None:
        import ray

        pool = self._pool(assignment.stage)
        seconds = time.monotonic() - assignment.started_at
        # The first call of a process warms it up: how long it took says little of the others, unless it was long.
        each = seconds / len(assignment.parts)
        call_seconds = each if assignment.process.tasks or seconds > WARM_UP_SECONDS else None
        try:
            answers, resident = ray.get(ref)
        except ray.exceptions.RayError as error:
            if isinstance(error, ray.exceptions.RayTaskError):
                pool.give_back(assignment.process, 0, len(assignment.parts))
            else:
                log.warning("process %d died at %s", assignment.process.pid, _names(assignment.leases))
                pool.note_death(assignment.process)
            if self._has_queued_alone(assignment):
                return
            result = process_failure(error, renders=assignment.stage is Stage.render)
            results = [with_damaged_inputs(result, lease.task, self._store) for lease in assignment.leases]
        else:
            pool.give_back(assignment.process, resident, len(assignment.parts))
            parts = zip(answers, assignment.parts, strict=True)
            results = [result for answer, leases in parts for result in _read_results(answer, leases)]
        results = [result.model_copy(update={"call_seconds": call_seconds}) for result in results]
        self._part_seconds[assignment.stage] = 0.8 * self._part_seconds.get(assignment.stage, each) + 0.2 * each
        if assignment.stage is Stage.simulate:
            each = seconds / len(assignment.leases)
            self._simulation_seconds = 0.8 * (self._simulation_seconds or each) + 0.2 * each
        self._settle(assignment, results)

    def _settle(self, assignment: Assignment, results: list[TaskResult]) -> None:
        seconds = time.monotonic() - assignment.started_at
        for lease, result in zip(assignment.leases, results, strict=True):
            tracing.record_task(lease, result, seconds, worker=self._settings.name)
            if result.outcome == "failed":
                log.warning("task %s failed: %s: %s", lease.task_id, result.reason, result.message)
            self._alone.discard(lease.task_id)
            if self._book.holds(lease):
                if not self._reports:
                    self._reports_due = time.monotonic() + REPORT_SECONDS
                self._reports.append(Report(task_id=lease.task_id, token=lease.token, result=result))

    def _has_queued_alone(self, assignment: Assignment) -> bool:
        """Queue the parts of a call that failed, to be done one by one; return False where there was only one.

        A render that ends its process must not count as a failure of renders in the same process.
        """
        if len(assignment.parts) == 1:
            return False
        log.warning("a call for %s failed; each is done again by itself", _names(assignment.leases))
        for lease in reversed(assignment.leases):
            if self._book.holds(lease):
                self._alone.add(lease.task_id)
                self._queues[assignment.stage].appendleft(lease)
        return True

    def _enforce_limits(self) -> None:
        """Kill what has run too long, and what nobody wants any more."""
        now = time.monotonic()
        for ref, assignment in list(self._running.items()):
            if not any(self._book.holds(lease) for lease in assignment.leases):
                # Most work ends by itself sooner than a new process would start.
                assignment.unwanted_since = assignment.unwanted_since or now
                if now < assignment.unwanted_since + self._settings.drop_seconds:
                    continue
            elif now < assignment.started_at + assignment.limit:
                continue
            del self._running[ref]
            self._pool(assignment.stage).end(assignment.process)
            if self._has_queued_alone(assignment):
                continue
            result = failed(
                Reason.exec_timeout,
                f"not done within {assignment.limit:.3g} s; process {assignment.process.pid} killed",
            )
            self._settle(assignment, [result] * len(assignment.leases))

    # --- work -----------------------------------------------------------------------------------------------

    def _pool(self, stage: Stage) -> Pool:
        return self._render_pool if stage is Stage.render else self._stage_pool

    def _start_work(self) -> None:
        """Give processes what is queued, as far as slots and processes are free."""
        for queue in self._queues.values():
            wanted = [lease for lease in queue if self._book.holds(lease)]
            if len(wanted) < len(queue):
                queue.clear()
                queue.extend(wanted)
        long = (self._simulation_seconds or 0.0) > LONG_SIMULATION
        waiting = {self._stage_pool: 0, self._render_pool: 0}
        for stage in reversed(Stage) if long else _PRECEDENCE:
            queue = self._queues[stage]
            pool = self._pool(stage)
            while queue and len(self._running) < self._open_slots():
                process = pool.take()
                if process is None:
                    waiting[pool] += self._calls(stage)
                    break
                self._assign(self._next_parts(queue), stage, process)
        for pool, count in waiting.items():
            pool.grow_if_worth(min(count, self._open_slots() - len(self._running)))

    def _next_parts(self, queue: deque[Lease]) -> list[list[Lease]]:
        """Take what one call does from `queue`."""
        parts = [_next_batch(queue)]
        if self._may_share_a_call(parts[0][0]):
            while queue and len(parts) < self._renders_at_once() and self._may_share_a_call(queue[0]):
                parts.append([queue.popleft()])
        return parts

    def _may_share_a_call(self, lease: Lease) -> bool:
        """Return whether a task is a render that shares no shading, and has not been in a call that failed."""
        return (
            isinstance(lease.task, RenderTask) and shading_of(lease.task) is None and lease.task_id not in self._alone
        )

    def _renders_at_once(self) -> int:
        """Return how many renders that share no shading are short enough to be one call."""
        each = max(self._part_seconds.get(Stage.render, SHORT_SECONDS), 1e-3)
        return min(max(int(SHORT_SECONDS / each), 1), MOST_AHEAD)

    def _calls(self, stage: Stage) -> int:
        """Return about how many calls the queued tasks of a stage take."""
        queue = self._queues[stage]
        if stage is Stage.simulate:
            return -(-len(queue) // LARGEST_BATCH)
        if stage is Stage.render:
            shadings = [shading_of(task) for task in _renders(queue)]
            return -(-shadings.count(None) // self._renders_at_once()) + len(set(shadings) - {None})
        return len(queue)

    def _assign(self, parts: list[list[Lease]], stage: Stage, process: Process) -> None:
        if stage is Stage.render:
            arguments: list[Any] = [merged(_renders(leases)).model_dump(mode="json") for leases in parts]
            ref = process.actor.call.remote("render", arguments)
        else:
            arguments = [_tasks.dump_json([lease.task for lease in leases]).decode() for leases in parts]
            ref = process.actor.call.remote("run", arguments)
        limits = [[lease.limit_seconds for lease in leases if lease.limit_seconds is not None] for leases in parts]
        limit = self._settings.exec_seconds[stage]
        if sum(map(len, limits)) == sum(map(len, parts)):
            # Tasks of a part are put together because they are alike: the longest limit is that of all of them.
            limit = min(limit, sum(map(max, limits)))
        assignment = Assignment(parts, stage, process, time.monotonic(), limit)
        self._running[ref] = assignment
        self._book.start(assignment.leases)

    def _open_slots(self) -> int:
        """Return how many calls may run now."""
        return self._slots + (EXPRESS_SLOTS if self._is_clogged() else 0)

    def _is_clogged(self) -> bool:
        """Return whether all slots have been taken for long: then short tasks have a slot of their own."""
        since = time.monotonic() - self._settings.clog_seconds
        return sum(assignment.started_at < since for assignment in self._running.values()) >= self._slots

    def _hand_back(self) -> None:
        """Give back what was leased before all slots were taken for long: another dispatcher may have one free."""
        if not self._was_clogged:
            self._release_queued()
        self._was_clogged = True

    def _ask_for_frames(self) -> None:
        """Ask simulations that take a while how far they are; heartbeats tell the coordinator."""
        import ray

        now = time.monotonic()
        for assignment in self._running.values():
            if assignment.stage is not Stage.simulate or len(assignment.leases) > 1:
                continue
            if assignment.asked is None:
                if now > max(assignment.asked_at, assignment.started_at) + FRAMES_SECONDS:
                    assignment.asked, assignment.asked_at = assignment.process.actor.frames.remote(), now
            elif ray.wait([assignment.asked], timeout=0)[0]:
                with contextlib.suppress(ray.exceptions.RayError):  # who has died is met in `_take_in`
                    if (frames := ray.get(assignment.asked)) is not None:
                        self._book.note_frames(assignment.leases[0], frames)
                assignment.asked = None

    # --- the coordinator ------------------------------------------------------------------------------------

    def _find_builds(self) -> None:
        """Start the first process of each pool and ask it what it is."""
        self._stage_pool.grow(1)
        self._render_pool.grow(1)
        while not self._stopping and None in (self._stage_pool.description, self._render_pool.description):
            self._collect(LONGEST_WAIT)
            self._stage_pool.check_starts()
            self._render_pool.check_starts()
            self._stage_pool.grow(1)
            self._render_pool.grow(1)

    def _open_session(self) -> None:
        """Register. What was leased in an earlier session is lost; the coordinator gives it out again."""
        if self._heartbeat is not None:
            self._heartbeat.stop()
            self._heartbeat = None
        if self._session is not None:
            log.warning("session %s is lost", self._session.worker_id)
            self._session = None
        self._book.clear()
        self._reports.clear()
        stage, render = self._stage_pool.description, self._render_pool.description
        assert stage is not None
        assert render is not None
        registration = WorkerRegistration(
            name=self._settings.name,
            builds={
                name: Builds(**own, render=render["builds"][name])
                for name, own in stage["builds"].items()
                if name in render["builds"]
            },
            slots=self._slots,
            versions={**stage["versions"], **render.get("versions", {})},
        )
        self._session = self._coordinator.register(registration)
        self._next_lease = 0.0
        self._heartbeat = HeartbeatThread(self._coordinator, self._session, self._book)
        self._heartbeat.start()
        log.info("registered as %s with %d slots", self._session.worker_id, self._slots)

    def _report(self) -> bool:
        """Send all reports; return whether there were any."""
        assert self._session is not None
        there_were = bool(self._reports)
        while self._reports:
            batch = tuple(islice(self._reports, REPORTS_A_REQUEST))
            answer = self._coordinator.report(ReportBatch(worker_id=self._session.worker_id, reports=batch))
            for report, verdict in zip(batch, answer.verdicts, strict=True):
                self._reports.popleft()
                self._book.remove(report.task_id, report.token)
                if verdict.verdict == "stale":
                    log.warning("the report of task %s came too late and was refused", report.task_id)
        return there_were

    def _lease(self) -> bool:
        """Ask for work if some is wanted and it is time; return whether there was any."""
        assert self._session is not None
        wanted = self._wanted()
        if not wanted or time.monotonic() < self._next_lease:
            return False
        clogged = self._is_clogged()
        at_most = self._settings.clog_seconds if clogged else None
        request = LeaseRequest(worker_id=self._session.worker_id, wanted=wanted, at_most_seconds=at_most)
        batch = self._coordinator.lease(request)
        self._next_lease = time.monotonic() + max(batch.retry_after_seconds, EXPRESS_POLL_SECONDS if clogged else 0.0)
        self._book.add(batch.leases)
        for lease in batch.leases:
            self._queues[Stage(lease.task.stage)].append(lease)
            if isinstance(lease.task, RenderTask):
                self._renders_share = shading_of(lease.task) is not None
        return bool(batch.leases)

    def _wanted(self) -> dict[Stage, int]:
        """Return how many tasks to ask for: little more than what can run, so that a kill gives little back."""
        queued = sum(self._calls(stage) for stage in self._queues)
        if self._is_clogged():
            free = queued == 0 and len(self._running) < self._open_slots()
            return {stage: LARGEST_BATCH if stage is Stage.simulate else 1 for stage in Stage} if free else {}
        self._was_clogged = False
        idle = self._slots - len(self._running) - queued
        wanted = {}
        for stage in (Stage.publish, Stage.pack, Stage.render):
            ahead = self._ahead(stage)
            if idle > 0 or queued <= ahead // 2:  # not for one at a time
                wanted[stage] = ahead + idle
        if wanted.get(Stage.render, 0) > 0:
            wanted[Stage.render] *= RENDERS_TOGETHER if self._renders_share else self._renders_at_once()
        if wanted and not self._queues[Stage.simulate]:
            short = self._simulation_seconds is not None and self._simulation_seconds <= LONG_SIMULATION
            wanted[Stage.simulate] = LARGEST_BATCH if short else self._slots
        return {stage: count for stage, count in wanted.items() if count > 0}

    def _ahead(self, stage: Stage) -> int:
        """Return how many calls of a stage to keep waiting."""
        seconds = self._part_seconds.get(stage, AHEAD_SECONDS)
        if stage is Stage.render:
            seconds *= self._renders_at_once()
        return self._slots * round(min(max(AHEAD_SECONDS / max(seconds, 1e-3), 1), MOST_AHEAD))

    # --- the end --------------------------------------------------------------------------------------------

    def _finish_running(self) -> None:
        """Give running work a moment to end; what is queued goes back at once."""
        deadline = time.monotonic() + self._settings.stop_seconds
        self._release_queued()
        while self._running and time.monotonic() < deadline:
            self._collect(min(LONGEST_WAIT, deadline - time.monotonic()))
            self._try_to_report()

    def _give_back(self) -> None:
        """End all processes and give all leases back, if the coordinator listens; it finds out by itself otherwise."""
        self._release_queued()
        if self._cluster.lost:
            result = failed(Reason.worker_lost, f"{self._cluster.lost} of the Ray cluster died")
            for assignment in self._running.values():
                self._settle(assignment, [result] * len(assignment.leases))
        else:
            self._stage_pool.close()
            self._render_pool.close()
            for assignment in self._running.values():
                for lease in assignment.leases:
                    self._release(lease)
        self._running.clear()
        for _ in range(3):
            if self._try_to_report():
                break
            time.sleep(0.3)
        if self._heartbeat is not None:
            self._heartbeat.stop()
        self._coordinator.close()

    def _release_queued(self) -> None:
        for queue in self._queues.values():
            while queue:
                self._release(queue.popleft())

    def _release(self, lease: Lease) -> None:
        if self._book.holds(lease):
            self._reports.append(Report(task_id=lease.task_id, token=lease.token, result=None))

    def _try_to_report(self) -> bool:
        if self._session is None:
            return True
        try:
            self._report()
        except CoordinatorError as error:
            log.warning("could not report: %s", error)
            return False
        return True


def _next_batch(queue: deque[Lease]) -> list[Lease]:
    """Take what one process can do together from `queue`: simulations of a kind, renders of a shading, or one task."""
    batch = [queue.popleft()]
    if isinstance(batch[0].task, RenderTask) and (shading := shading_of(batch[0].task)) is not None:
        others = [lease for lease in queue if isinstance(lease.task, RenderTask) and shading_of(lease.task) == shading]
        batch += others[: RENDERS_TOGETHER - 1]
        for lease in batch[1:]:
            queue.remove(lease)
        return batch
    simulated = _simulated_kind(batch[0])
    limit = 1 if simulated is None else kind(simulated).batch
    while queue and len(batch) < limit and _simulated_kind(queue[0]) == simulated:
        batch.append(queue.popleft())
    return batch


def _read_results(answer: Any, leases: list[Lease]) -> list[TaskResult]:
    """Return the result of each lease: the renderer answers with a dict, the stages with JSON."""
    try:
        if isinstance(answer, dict):
            return split(_renders(leases), TaskResult.model_validate(answer))
        return _results.validate_json(answer)
    except ValidationError as error:
        return [failure(error)] * len(leases)


def _renders(leases: Iterable[Lease]) -> list[RenderTask]:
    return [lease.task for lease in leases if isinstance(lease.task, RenderTask)]


def _simulated_kind(lease: Lease) -> str | None:
    return lease.task.simulation.kind if isinstance(lease.task, SimulateTask) else None


def _names(leases: list[Lease]) -> str:
    return leases[0].task_id if len(leases) == 1 else f"{leases[0].task_id} and {len(leases) - 1} more"
