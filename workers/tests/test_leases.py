"""The lease book: what a late answer says of an old lease does not touch a new one."""

from stickslip_schemas.documents.tasks import SimulateTask
from stickslip_schemas.documents.worker_api import Lease
from stickslip_schemas.kinds.rod_hang import RodHangSimulation
from stickslip_workers.leases import LeaseBook


def _lease(token: int) -> Lease:
    task = SimulateTask(simulation=RodHangSimulation(gamma=1.0, phi0=0.0, phi1=0.0, poisson=0.5))
    return Lease(task_id="one", token=token, attempt=1, task=task)


def test_a_late_drop_spares_a_newer_lease() -> None:
    book = LeaseBook()
    book.add([_lease(1)])
    said = book.states()
    book.add([_lease(2)])
    book.drop(["one"], as_of=said)
    assert book.holds(_lease(2))
    assert not book.holds(_lease(1))
    book.drop(["one"], as_of=book.states())
    assert book.states() == ()


def test_started_is_said_and_a_reported_lease_forgotten() -> None:
    book = LeaseBook()
    book.add([_lease(1)])
    assert [state.started for state in book.states()] == [False]
    book.start([_lease(1)])
    assert [state.started for state in book.states()] == [True]
    book.remove("one", 7)
    assert book.holds(_lease(1))
    book.remove("one", 1)
    assert book.states() == ()
