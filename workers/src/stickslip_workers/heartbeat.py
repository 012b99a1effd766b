"""The heartbeat: renews leases from a thread of its own, whatever the dispatcher's loop is busy with."""

import logging
import threading

from stickslip_schemas.documents.worker_api import Heartbeat, WorkerSession

from stickslip_workers.coordinator_client import CoordinatorClient, CoordinatorError, UnknownWorkerError
from stickslip_workers.leases import LeaseBook

log = logging.getLogger(__name__)

LAST_BEAT_SECONDS = 5.0
"""How long a heartbeat that is under way may take when it is told to stop."""


class HeartbeatThread(threading.Thread):
    """Beats three times a lease. A daemon: it never keeps the process alive."""

    def __init__(self, coordinator: CoordinatorClient, session: WorkerSession, book: LeaseBook) -> None:
        super().__init__(name="heartbeat", daemon=True)
        self._coordinator = coordinator
        self._session = session
        self._book = book
        self._ended = threading.Event()
        self.session_lost = threading.Event()
        """Set when the coordinator does not know the session any more; the thread ends then."""

    def stop(self) -> None:
        """Beat no more. A beat that is under way may end first: its connection is about to be closed."""
        self._ended.set()
        self.join(LAST_BEAT_SECONDS)

    def run(self) -> None:
        """Beat until told to stop."""
        interval = self._session.lease_seconds / 3
        wait = interval
        while not self._ended.wait(wait):
            states = self._book.states()
            try:
                answer = self._coordinator.heartbeat(Heartbeat(worker_id=self._session.worker_id, leases=states))
            except UnknownWorkerError:
                self.session_lost.set()
                return
            except CoordinatorError as error:
                log.warning("no heartbeat: %s", error)
                wait = min(1.0, interval)  # the lease is running out: a beat that failed is not skipped
                continue
            wait = interval
            if answer.drop:
                log.info("dropping %d tasks", len(answer.drop))
                self._book.drop(answer.drop, as_of=states)
