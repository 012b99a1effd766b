"""Whether the times that were foretold come true: every few seconds the interval of each running job is noted down."""

from collections import Counter
from collections.abc import Mapping

from stickslip_schemas.base.states import JobState
from stickslip_schemas.documents.responses import Job

EVERY_SECONDS = 5.0
"""Time between two notes [s]."""

MOST_NOTES = 2000
"""Notes of one job; with more, every other one is dropped."""

_DONE = (JobState.succeeded, JobState.succeeded_with_rejects)
_GOING_ON = (JobState.queued, JobState.running)


class EtaWatch:
    """Notes of what was foretold, and how often it held. Not kept over a restart."""

    def __init__(self) -> None:
        self._notes: dict[str, list[tuple[float, float]]] = {}
        self._next = float("-inf")
        self.held: Counter[tuple[str, bool]] = Counter()
        """Notes by kind, and by whether the job ended within the interval."""

    def is_due(self, now: float) -> bool:
        """Tell whether it is time for a note."""
        return now >= self._next

    @property
    def watched(self) -> frozenset[str]:
        """The jobs whose end is waited for."""
        return frozenset(self._notes)

    def look(self, jobs: Mapping[str, Job], now: float) -> None:
        """Note what is foretold of jobs by id, and judge the notes of those that have ended."""
        self._next = now + EVERY_SECONDS
        for job in jobs.values():
            if job.state in _GOING_ON and job.progress.eta is not None:
                notes = self._notes.setdefault(job.id, [])
                notes.append((now + job.progress.eta.low, now + job.progress.eta.high))
                if len(notes) > MOST_NOTES:
                    del notes[::2]
            elif job.state not in _GOING_ON:  # what was paused, cancelled or has failed says nothing of durations
                notes = self._notes.pop(job.id, [])
                if job.state in _DONE and job.finished_at is not None:
                    end = job.finished_at.timestamp()
                    self.held.update((job.kind, low <= end <= high) for low, high in notes)
