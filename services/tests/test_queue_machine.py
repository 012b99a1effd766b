"""The queue against a small model of it, in any order of events, with an audit of the tables after
each.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    consumes,
    initialize,
    invariant,
    multiple,
    rule,
)
from sqlalchemy import select
from stickslip_schemas.base import JobState, Reason
from stickslip_schemas.documents.worker_api import Lease
from stickslip_services.database.tables import job_tasks, jobs, ready_tasks, tasks
from stickslip_services.errors import ConflictError
from stickslip_services.queue.background import start, sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job, pause_job, prioritise_job, resume_job
from stickslip_services.queue.leaving import QueueCleaner
from stickslip_services.queue.planner import Planner
from stickslip_services.queue.rows import SCHEDULABLE
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.invariants import unsettled, violations
from stickslip_testing.jobs import ManualClock, list_datasets, list_jobs, parsed, rods, show_job
from stickslip_testing.worker import DirectApi, PretendWorker, failure, rejection

if TYPE_CHECKING:
    from stickslip_testing.postgresql import PostgresqlServer

SPECS = (
    rods(gamma=(1.0,)),
    rods(gamma=(1.0, 2.0)),  # shares tasks with the first
    rods(gamma=(2.0,), views=None),  # and with the second
    rods(gamma=(2.0,), phi1=(1.0,)),  # all of it is rejected
    rods(
        gamma=(1.0, 3.0, 4.0)
    ),  # too many samples to be planned at once; shares tasks with the first two
)
PLAN_SAMPLES = 4

CLEANED_ROWS = 2
"""Rows of a piece that is removed from the queue."""

HOW = ("well", "well", "well", "crashed", "crashed", "broken", "lost", "released")
"""How a task ends, the likely ways more often."""

Held = tuple[PretendWorker, Lease]


def _judge(task: Any) -> Any:
    return rejection() if task.stage == "simulate" and task.simulation.gamma == 2.0 else None


class QueueMachine(RuleBasedStateMachine):
    """The model: who holds what until when, what was reported, what is settled."""

    server: ClassVar["PostgresqlServer | None"] = None
    """Where the database is; None: SQLite."""

    submitted = Bundle("submitted")
    leases = Bundle("leases")
    reported = Bundle("reported")

    @initialize()
    def begin(self) -> None:
        self.directory = tempfile.TemporaryDirectory()
        self.clock = ManualClock()
        self.settings = Settings.chosen(
            data=Path(self.directory.name),
            durable=False,
            plan_samples=PLAN_SAMPLES,
            database=None if self.server is None else self.server.clean(),
        )
        self.context = Context.open(self.settings, self.clock)
        start(self.context)
        self.planner = Planner(self.context)
        self.cleaner = QueueCleaner(self.context, piece=CLEANED_ROWS)
        self.workers: dict[str, PretendWorker] = {}
        self.holders: dict[str, tuple[str, int, float]] = {}  # task -> worker id, token, expiry
        self.last_seen: dict[str, float] = {}  # worker id -> when it beat or reported last
        self.tokens: dict[str, int] = {}
        self.settled: set[str] = set()
        self.manifests: dict[tuple[str, int], str] = {}
        self.ended: dict[str, JobState] = {}
        self.register("a")

    # --- what happens
    # --------------------------------------------------------------------------------------------

    @rule(target=submitted, number=st.integers(0, len(SPECS) - 1))
    def submit(self, number: int) -> str:
        job = submit_job(self.context, parsed(SPECS[number]), None)
        return job.id  # type: ignore[union-attr]

    @rule()
    def plan(self) -> None:
        """Plan a piece of a job."""
        waiting = {job.id: job for job in list_jobs(self.context) if job.state is JobState.planning}
        assert self.planner.step() == bool(waiting)
        grown = [
            job.progress.planned - waiting[job.id].progress.planned
            for job in list_jobs(self.context)
            if job.id in waiting
        ]
        assert sorted(grown)[:-1] == [0] * (len(grown) - 1), "one piece of one job"
        assert not grown or 0 < max(grown) <= PLAN_SAMPLES

    @rule(name=st.sampled_from(("a", "b")))
    def register(self, name: str) -> None:
        old = self.workers.get(name)
        worker = PretendWorker(
            DirectApi(self.context), self.context.store, name=name, judge=_judge
        ).register()
        if old is not None:
            self.holders = {task: held for task, held in self.holders.items() if held[0] != old.id}
        self.workers[name] = worker
        self.last_seen[worker.id] = self.clock()

    @rule(
        target=leases,
        name=st.sampled_from(("a", "b")),
        count=st.integers(1, 3),
        pause=st.sampled_from((0.0, 31.0)),
    )
    def lease(self, name: str, count: int, pause: float) -> Any:
        self.clock.advance(pause)
        worker = self.workers.get(name)
        if worker is None:
            return multiple()
        self._forget_expired()
        granted = worker.lease(simulate=count, render=count, pack=count, publish=count)
        for lease in granted:
            assert lease.task_id not in self.holders, "leased twice"
            assert lease.task_id not in self.settled, "leased although it has a result"
            assert self._is_asked_for(lease.task_id), "leased for a paused job"
            assert lease.token == self.tokens.get(lease.task_id, 0) + 1
            self.tokens[lease.task_id] = lease.token
            self.holders[lease.task_id] = (
                worker.id,
                lease.token,
                self.clock() + self.settings.lease_seconds,
            )
        return multiple(*((worker, lease) for lease in granted))

    @rule(held=leases, started=st.booleans())
    def heartbeat(self, held: Held, started: bool) -> None:
        worker, lease = held
        dropped = worker.beat(lease, started=started)
        self.last_seen[worker.id] = now = self.clock()
        # A lease that has had its duration, and that its worker does not list, was lost on the way.
        self.holders = {
            task: held
            for task, held in self.holders.items()
            if task == lease.task_id or held[0] != worker.id or held[2] > now
        }
        if dropped:
            # Either it was not the worker's, or no job needs it: then it is nobody's now.
            if self._holds(worker, lease):
                del self.holders[lease.task_id]
        else:
            assert self._holds(worker, lease)
            self.holders[lease.task_id] = (
                worker.id,
                lease.token,
                self.clock() + self.settings.lease_seconds,
            )

    @rule(target=reported, held=consumes(leases), how=st.sampled_from(HOW))
    def report(self, held: Held, how: str) -> Held:
        worker, lease = held
        is_held = self._holds(worker, lease)
        bad = {
            "crashed": failure(),
            "broken": failure(Reason.internal_error),
            "lost": failure(Reason.worker_lost),
            "released": None,
        }
        result = worker.result(lease.task) if how == "well" else bad[how]
        verdict = worker.report((lease, result))
        self.last_seen[worker.id] = self.clock()
        assert verdict == (["accepted"] if is_held else ["stale"])
        if is_held:
            del self.holders[lease.task_id]
            if how == "well":
                self.settled.add(lease.task_id)
        return held

    @rule(held=reported)
    def report_again(self, held: Held) -> None:
        worker, lease = held
        before = dict(self.holders)
        assert worker.report((lease, failure())) in (["duplicate"], ["stale"])
        self.last_seen[worker.id] = self.clock()
        assert self.holders == before

    @rule(job=submitted)
    def cancel(self, job: str) -> None:
        try:
            detail = cancel_job(self.context, job)
        except ConflictError:
            assert self.ended[job] is not JobState.cancelled
        else:
            assert detail.state in (JobState.cancelling, JobState.cancelled)

    @rule(job=submitted)
    def pause(self, job: str) -> None:
        try:
            detail = pause_job(self.context, job)
        except ConflictError:
            assert job in self.ended or show_job(self.context, job).state is JobState.cancelling
        else:
            assert detail.state in (JobState.pausing, JobState.paused)

    @rule(job=submitted)
    def resume(self, job: str) -> None:
        try:
            detail = resume_job(self.context, job)
        except ConflictError:
            assert job in self.ended or show_job(self.context, job).state is JobState.cancelling
        else:
            assert detail.state in (JobState.planning, JobState.queued, JobState.running)

    @rule(job=submitted, priority=st.integers(-2, 2))
    def prioritise(self, job: str, priority: int) -> None:
        try:
            assert prioritise_job(self.context, job, priority).priority == priority
        except ConflictError:
            assert job in self.ended

    @rule(seconds=st.sampled_from((1.0, 5.0, 29.0, 31.0)))
    def wait(self, seconds: float) -> None:
        self.clock.advance(seconds)

    @rule()
    def sweep(self) -> None:
        sweep(self.context)
        self._forget_expired()
        with self.context.database.read() as connection:
            assert unsettled(connection) == []

    @rule()
    def clean(self) -> None:
        """Remove a piece of an ended job from the queue."""
        leaving, rows = self._leaving_jobs(), self._queued_rows()
        assert self.cleaner.step() == bool(leaving)
        removed = rows - self._queued_rows()
        assert {job for job, _ in removed} <= leaving
        has_left = leaving - self._leaving_jobs()
        assert len(removed) in ((1, CLEANED_ROWS) if leaving and not has_left else (0,))
        assert has_left.isdisjoint(job for job, _ in self._queued_rows())

    @rule()
    def restart(self) -> None:
        self.context.close()
        self.context = Context.open(self.settings, self.clock)
        start(self.context)
        self.planner = Planner(self.context)
        self.cleaner = QueueCleaner(self.context, piece=CLEANED_ROWS)
        for worker in self.workers.values():
            worker.api = DirectApi(self.context)
        expiry = self.clock() + self.settings.lease_seconds
        self.holders = {
            task: (worker, token, expiry) for task, (worker, token, _) in self.holders.items()
        }

    # --- what must hold
    # ------------------------------------------------------------------------------------------

    @invariant()
    def tables_agree(self) -> None:
        with self.context.database.read() as connection:
            assert violations(connection) == []

    @invariant()
    def what_has_ended_stays_so(self) -> None:
        for job in list_jobs(self.context):
            if not job.state.is_open:
                assert self.ended.setdefault(job.id, job.state) is job.state
            else:
                assert job.id not in self.ended
        for dataset in list_datasets(self.context):
            for version in dataset.versions:
                key = (dataset.id, version.version)
                assert self.manifests.setdefault(key, version.manifest) == version.manifest

    def teardown(self) -> None:
        if not hasattr(self, "context"):
            return
        # However it went: once no job is paused, a worker that does its work brings every job to
        # its end.
        for job in list_jobs(self.context):
            if job.state in (JobState.pausing, JobState.paused):
                resume_job(self.context, job.id)
        worker = PretendWorker(
            DirectApi(self.context), self.context.store, name="last", judge=_judge
        ).register()
        for _ in range(10):
            self.clock.advance(60)
            self.planner.run()
            worker.work()
            sweep(self.context)
        for job in list_jobs(self.context):
            assert not job.state.is_open, f"{job.id} is {job.state}"
        self.tables_agree()
        while self.cleaner.step():
            pass
        assert not self._queued_rows(), "the queue of ended jobs is empty"
        self.context.close()
        self.directory.cleanup()

    def _is_asked_for(self, task: str) -> bool:
        """Return whether a job that may run needs the task."""
        with self.context.database.read() as connection:
            job = connection.scalar(
                select(jobs.c.seq)
                .join(job_tasks, job_tasks.c.job == jobs.c.seq)
                .join(tasks, tasks.c.seq == job_tasks.c.task)
                .where(
                    tasks.c.key == bytes.fromhex(task.partition("-")[2]),
                    jobs.c.state.in_(SCHEDULABLE),
                )
                .limit(1)
            )
        return job is not None

    def _leaving_jobs(self) -> set[int]:
        with self.context.database.read() as connection:
            return set(connection.scalars(select(jobs.c.seq).where(jobs.c.leaves_queue)))

    def _queued_rows(self) -> set[tuple[int, int]]:
        """Return the rows of the queue: job and task."""
        with self.context.database.read() as connection:
            rows = connection.execute(select(ready_tasks.c.job, ready_tasks.c.task))
            return {(row.job, row.task) for row in rows}

    def _holds(self, worker: PretendWorker, lease: Lease) -> bool:
        """Return whether nobody has taken the task back: a late sign of life is welcome."""
        held = self.holders.get(lease.task_id)
        return held is not None and held[:2] == (worker.id, lease.token)

    def _forget_expired(self) -> None:
        """Forget leases that have had their duration, of workers that were silent for as long."""
        now, seconds = self.clock(), self.settings.lease_seconds
        self.holders = {
            task: held
            for task, held in self.holders.items()
            if held[2] > now or self.last_seen[held[0]] > now - seconds
        }


@contextmanager
def _no_fsync() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.fsync", lambda _descriptor: None)
        yield


def run_machine(machine: type[QueueMachine]) -> None:
    from hypothesis.stateful import run_state_machine_as_test

    profile = settings(
        max_examples=15,
        stateful_step_count=30,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )
    with _no_fsync():
        run_state_machine_as_test(machine, settings=profile)


@pytest.mark.physics
def test_the_queue_in_any_order() -> None:
    run_machine(QueueMachine)


@pytest.mark.slow
def test_the_queue_in_any_order_on_postgresql(postgresql: "PostgresqlServer") -> None:
    class Machine(QueueMachine):
        server = postgresql

    run_machine(Machine)
