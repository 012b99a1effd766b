"""The heartbeat's thread."""

import threading
from typing import Any, cast

from stickslip_schemas.documents.worker_api import Heartbeat, HeartbeatAnswer, WorkerSession
from stickslip_workers.heartbeat import HeartbeatThread
from stickslip_workers.leases import LeaseBook


class SlowCoordinator:
    """Answers when it is told to."""

    def __init__(self) -> None:
        self.asked, self.may_answer = threading.Event(), threading.Event()

    def heartbeat(self, _: Heartbeat) -> HeartbeatAnswer:
        self.asked.set()
        assert self.may_answer.wait(timeout=4)
        return HeartbeatAnswer(drop=())


def test_a_beat_that_is_under_way_ends_before_its_connection_is_closed() -> None:
    coordinator = SlowCoordinator()
    session = WorkerSession(worker_id="worker-1", lease_seconds=0.03)
    heartbeat = HeartbeatThread(cast(Any, coordinator), session, LeaseBook())
    heartbeat.start()
    assert coordinator.asked.wait(timeout=10)
    threading.Timer(0.2, coordinator.may_answer.set).start()
    heartbeat.stop()
    assert not heartbeat.is_alive()
