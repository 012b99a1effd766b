"""The leases that the dispatcher holds: shared between its loop and its heartbeat."""

import threading
from collections.abc import Iterable

from stickslip_schemas.documents.worker_api import Lease, LeaseState


class LeaseBook:
    """What the next heartbeat says. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._states: dict[str, LeaseState] = {}

    def add(self, leases: Iterable[Lease]) -> None:
        """Note new leases."""
        with self._lock:
            for lease in leases:
                self._states[lease.task_id] = LeaseState(task_id=lease.task_id, token=lease.token, started=False)

    def start(self, leases: Iterable[Lease]) -> None:
        """Note that the tasks have been started."""
        with self._lock:
            for lease in leases:
                self._states[lease.task_id] = LeaseState(task_id=lease.task_id, token=lease.token, started=True)

    def note_frames(self, lease: Lease, frames: tuple[int, int]) -> None:
        """Note how far a started task is: frames done, and frames."""
        with self._lock:
            state = self._states.get(lease.task_id)
            if state is not None and state.token == lease.token:
                self._states[lease.task_id] = state.model_copy(update={"frames": frames})

    def remove(self, task_id: str, token: int) -> None:
        """Forget a lease; a newer one of the same task stays."""
        with self._lock:
            state = self._states.get(task_id)
            if state is not None and state.token == token:
                del self._states[task_id]

    def holds(self, lease: Lease) -> bool:
        """Tell whether the lease is still ours."""
        with self._lock:
            state = self._states.get(lease.task_id)
            return state is not None and state.token == lease.token

    def drop(self, task_ids: Iterable[str], *, as_of: Iterable[LeaseState]) -> None:
        """Forget the tasks that a heartbeat, sent with the states `as_of`, was told to drop.

        A lease that was granted since then is another one and stays.
        """
        tokens = {state.task_id: state.token for state in as_of}
        with self._lock:
            for task_id in task_ids:
                state = self._states.get(task_id)
                if state is not None and state.token == tokens.get(task_id):
                    del self._states[task_id]

    def clear(self) -> None:
        """Forget all: the session is over."""
        with self._lock:
            self._states.clear()

    def states(self) -> tuple[LeaseState, ...]:
        """Return what a heartbeat says now."""
        with self._lock:
            return tuple(self._states.values())
