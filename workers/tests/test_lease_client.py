"""The client of the worker API: the back-off, the leases held and their heartbeat."""

import threading
import time
from typing import Any, cast

import pytest
from stickslip_schemas.base import Reason
from stickslip_schemas.documents.tasks import SimulateTask, TaskResult
from stickslip_schemas.documents.worker_api import (
    Heartbeat,
    HeartbeatAnswer,
    Lease,
    WorkerCondition,
    WorkerRegistration,
    WorkerSession,
)
from stickslip_schemas.kinds.rod_hang import RodHangSimulation
from stickslip_workers.lease_client import Backoff, CoordinatorError, LeaseTable, Session


def test_the_back_off_doubles_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("random.uniform", lambda low, high: high)
    monkeypatch.setattr(time, "monotonic", lambda: 100.0)
    backoff, waits = Backoff(first=0.2, most=1.0), []
    for _ in range(4):
        backoff.failed()
        waits.append(backoff.next_try - 100.0)
    assert waits == pytest.approx([0.2, 0.4, 0.8, 1.0])
    backoff.succeeded()
    assert backoff.next_try == 0.0
    assert backoff.failed() == pytest.approx(0.2)


class SlowCoordinator:
    """Answers heartbeats when it is set to."""

    def __init__(self) -> None:
        self.asked, self.may_answer = threading.Event(), threading.Event()

    def register(self, _: WorkerRegistration) -> WorkerSession:
        return WorkerSession(worker_id="worker-1", lease_seconds=0.03)

    def heartbeat(self, _: Heartbeat) -> HeartbeatAnswer:
        self.asked.set()
        assert self.may_answer.wait(timeout=60)
        return HeartbeatAnswer(drop=())

    def close(self) -> None:
        assert self.may_answer.is_set()


def test_a_heartbeat_in_progress_ends_before_its_connection_is_closed() -> None:
    coordinator = SlowCoordinator()
    registration = WorkerRegistration(
        name="test", builds={}, versions={}, condition=WorkerCondition(slots=0)
    )
    session = Session(cast(Any, coordinator), lambda: registration)
    session.start()
    assert coordinator.asked.wait(timeout=60)
    assert session.worker_id == "worker-1"
    threading.Timer(0.2, coordinator.may_answer.set).start()
    session.close()
    assert not session.is_alive()


def test_what_the_coordinator_refuses_ends_the_session() -> None:
    class Refusing(SlowCoordinator):
        def register(self, _: WorkerRegistration) -> WorkerSession:
            raise CoordinatorError("wrong key")

    registration = WorkerRegistration(
        name="test", builds={}, versions={}, condition=WorkerCondition(slots=0)
    )
    session = Session(cast(Any, Refusing()), lambda: registration)
    session.start()
    session.join(timeout=60)
    with pytest.raises(CoordinatorError, match="wrong key"):
        _ = session.worker_id


def _lease(token: int) -> Lease:
    task = SimulateTask(simulation=RodHangSimulation(gamma=1.0, phi0=0.0, phi1=0.0, poisson=0.5))
    return Lease(task_id="one", token=token, attempt=1, task=task)


def test_a_late_drop_spares_a_newer_lease() -> None:
    table = LeaseTable()
    table.add([_lease(1)])
    states = table.states()
    table.add([_lease(2)])
    table.remove(states)
    assert table.holds(_lease(2))
    assert not table.holds(_lease(1))
    table.remove(table.states())
    assert table.states() == ()


def test_started_is_said_and_a_reported_lease_forgotten() -> None:
    table = LeaseTable()
    table.add([_lease(1)])
    assert [state.started for state in table.states()] == [False]
    table.update([_lease(1)], started=True)
    assert [state.started for state in table.states()] == [True]
    table.update([_lease(7)], started=False)
    table.remove([_lease(7)])
    assert [state.started for state in table.states()] == [True]
    table.remove([_lease(1)])
    table.update([_lease(1)], started=True)
    assert table.states() == ()


def test_a_result_goes_with_its_lease() -> None:
    table, result = (
        LeaseTable(),
        TaskResult(outcome="failed", reason=Reason.internal_error, message=""),
    )
    table.add([_lease(1)])
    table.put_result(_lease(7), result)  # not held
    assert table.reports() == ()
    table.put_result(_lease(1), result)
    table.return_unfinished(started=True)  # it has a result
    assert [(report.token, report.result) for report in table.reports()] == [(1, result)]
    table.add([_lease(2)])
    assert table.reports() == ()
    table.return_unfinished(started=False)
    assert [(report.token, report.result) for report in table.reports()] == [(2, None)]
    table.remove(table.reports())
    assert table.states() == ()
