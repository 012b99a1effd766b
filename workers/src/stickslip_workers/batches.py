"""What one call does: simulations of a kind, renders of a shading, some short renders, or one task."""

import math
from collections import deque
from collections.abc import Collection, Iterable
from typing import Any

from pydantic import TypeAdapter, ValidationError
from stickslip_schemas.base.states import Stage
from stickslip_schemas.documents.tasks import RenderTask, SimulateTask, Task, TaskResult
from stickslip_schemas.documents.worker_api import Lease

from stickslip_workers.kinds import kind, kind_names
from stickslip_workers.results import failure, merged, shading_of, split
from stickslip_workers.stages.run import AnyTask

Parts = list[list[Lease]]
"""The tasks of a call. Those of a part have one answer together: all simulations, or renders of one shading."""

RENDERS_TOGETHER = 12
"""Renders of one shading that one call makes at most; so many are leased ahead, for they cost little more than one."""

SHORT_SECONDS = 1.0
"""Renders that share no shading are one call, if they take so long together [s]: a call costs 10 ms."""

MOST_TOGETHER = 16
"""Renders that share no shading in one call, and calls that wait here for each CPU, are no more than so many."""

AHEAD_SECONDS = 2.0
"""Calls that wait here for each CPU are enough for so long [s]. To ask for them costs the coordinator about 10 ms."""

LARGEST_BATCH = max(kind(name).batch for name in kind_names())
"""How many simulations to ask for at once: one call takes them all."""

LONG_SIMULATION = 2.0
"""Simulations that take longer [s] go after renders: clips come out while others are simulated, and the time left
is known for both. Of such no more are leased than run soon, for another dispatcher may have nothing to do."""

_WEIGHT = 0.2
"""Of the last call in the mean of their times."""

_tasks: TypeAdapter[list[AnyTask]] = TypeAdapter(list[Task])
_results = TypeAdapter(list[TaskResult])


class Pace:
    """How long calls take, lately [s]."""

    def __init__(self) -> None:
        self._part: dict[Stage, float] = {}
        self._simulation: float | None = None
        self.renders_share = False
        """Whether the last renders that were leased share shadings."""

    def note(self, stage: Stage, parts: Parts, seconds: float) -> None:
        """Note the duration of a call."""
        self._part[stage] = _mean(self._part.get(stage), seconds / len(parts))
        if stage is Stage.simulate:
            self._simulation = _mean(self._simulation, seconds / sum(map(len, parts)))

    def order(self) -> Iterable[Stage]:
        """Return what goes first: the end of a job before its beginning, but simulations, while they are short, before
        renders.
        """
        stages = list(reversed(Stage))
        return stages if self.is_long() else sorted(stages, key=lambda stage: stage is Stage.render)

    def is_long(self) -> bool:
        """Return whether simulations take long."""
        return (self._simulation or 0.0) > LONG_SIMULATION

    def part(self, stage: Stage) -> float | None:
        """Return how long a part of a call takes; None where that is not known."""
        return self._part.get(stage)

    def renders_at_once(self) -> int:
        """Return how many renders that share no shading are short enough to be one call."""
        return min(max(int(SHORT_SECONDS / max(self._part.get(Stage.render, SHORT_SECONDS), 1e-3)), 1), MOST_TOGETHER)

    def wanted(self, stage: Stage, calls: int) -> int:
        """Return how many tasks to ask for, for some calls."""
        if stage is Stage.simulate:
            return calls if self._simulation is None or self.is_long() else LARGEST_BATCH
        if stage is Stage.render:
            return calls * (RENDERS_TOGETHER if self.renders_share else self.renders_at_once())
        return calls

    def ahead(self, stage: Stage) -> int:
        """Return how many calls of a stage should wait here, for each CPU."""
        seconds = self._part.get(stage, math.inf) * (self.renders_at_once() if stage is Stage.render else 1)
        return round(min(AHEAD_SECONDS / max(seconds, 1e-3), MOST_TOGETHER))

    def calls(self, stage: Stage, queue: Collection[Lease]) -> int:
        """Return about how many calls some tasks of a stage take."""
        if stage is Stage.simulate:
            return -(-len(queue) // LARGEST_BATCH)
        if stage is Stage.render:
            shadings = [shading_of(task) for task in renders(queue)]
            return -(-shadings.count(None) // self.renders_at_once()) + len(set(shadings) - {None})
        return len(queue)

    def next_parts(self, queue: deque[Lease], alone: Collection[str]) -> Parts:
        """Take what one call does from `queue`; the tasks `alone` share a call with none."""

        def may_share(lease: Lease) -> bool:
            is_render = isinstance(lease.task, RenderTask) and shading_of(lease.task) is None
            return is_render and lease.task_id not in alone

        parts = [_next_part(queue)]
        if may_share(parts[0][0]):
            while queue and len(parts) < self.renders_at_once() and may_share(queue[0]):
                parts.append([queue.popleft()])
        return parts


def _mean(before: float | None, last: float) -> float:
    return last if before is None else (1 - _WEIGHT) * before + _WEIGHT * last


def _next_part(queue: deque[Lease]) -> list[Lease]:
    part = [queue.popleft()]
    if isinstance(part[0].task, RenderTask) and (shading := shading_of(part[0].task)) is not None:
        others = [lease for lease in queue if isinstance(lease.task, RenderTask) and shading_of(lease.task) == shading]
        part += others[: RENDERS_TOGETHER - 1]
        for lease in part[1:]:
            queue.remove(lease)
        return part
    simulated = _simulated_kind(part[0])
    limit = 1 if simulated is None else kind(simulated).batch
    while queue and len(part) < limit and _simulated_kind(queue[0]) == simulated:
        part.append(queue.popleft())
    return part


def _simulated_kind(lease: Lease) -> str | None:
    return lease.task.simulation.kind if isinstance(lease.task, SimulateTask) else None


def renders(leases: Iterable[Lease]) -> list[RenderTask]:
    """Return the renders among some tasks."""
    return [lease.task for lease in leases if isinstance(lease.task, RenderTask)]


def arguments_of(parts: Parts) -> list[Any]:
    """Return what the process is given for each part: the renderer takes dicts, the stages JSON."""
    if isinstance(parts[0][0].task, RenderTask):
        return [merged(renders(leases)).model_dump(mode="json") for leases in parts]
    return [_tasks.dump_json([lease.task for lease in leases]).decode() for leases in parts]


def results_of(answer: Any, part: list[Lease]) -> list[TaskResult]:
    try:
        if isinstance(answer, dict):
            return split(renders(part), TaskResult.model_validate(answer))
        return _results.validate_json(answer)
    except ValidationError as error:
        return [failure(error)] * len(part)


def limit_of(parts: Parts, most: float) -> float:
    """Return how long a call may take [s], `most` where that of a task is not known."""
    limits = [[lease.limit_seconds for lease in part if lease.limit_seconds is not None] for part in parts]
    if sum(map(len, limits)) < sum(map(len, parts)):
        return most
    # Tasks of a part are put together because they are alike: the longest limit is that of all of them.
    return min(most, sum(map(max, limits)))
