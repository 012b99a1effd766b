"""Calls: simulations of a kind, renders of a shading, some short renders, or one task, which Ray does together."""

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

from pydantic import ValidationError
from stickslip_schemas.base import Stage, canonical_json
from stickslip_schemas.documents.tasks import (
    RenderOutput,
    RenderTask,
    SimulateTask,
    TaskResult,
    results_adapter,
    tasks_adapter,
)
from stickslip_schemas.documents.worker_api import Lease
from stickslip_schemas.kinds import KINDS

from stickslip_workers.builds import kind
from stickslip_workers.stages.run import failure

STAGE_BYTES = {Stage.simulate: 2**28, Stage.render: 2**30, Stage.pack: 2**29, Stage.publish: 2**29}
"""Memory of a process without a mesh [bytes]. Measured: 152 MiB after 512 rods."""

VERTEX_BYTES = 96 * 1024
"""Memory for each vertex of a mesh [bytes]. Measured: 60 kB with 81 x 81 and 161 x 161 vertices; contacts need more."""

MOST_TOGETHER = 12
"""Renders in one call, and calls that wait here for each CPU, are no more than so many."""

ENOUGH_SECONDS = 2.0
"""Renders that share no shading are one call if they take so long together, and calls that wait here for each CPU are
enough for twice as long [s]. A call costs 10 ms, a request for tasks too; but another dispatcher may have nothing."""

LARGEST_BATCH = max(kind(name).batch for name in KINDS)
"""How many tasks to ask for at once at most: one call takes as many simulations."""


@dataclass(eq=False)
class Call:
    """What one task of Ray does. A call without parts only starts a process."""

    stage: Stage
    parts: list[list[Lease]]
    """Its tasks. Those of a part have one answer together: all simulations, or renders of one shading."""
    is_short: bool = False
    """Whether its tasks were leased because they are short, while all CPUs had been taken for long."""
    is_express: bool = False
    """Whether it needs no free CPU."""
    reference: Any = None
    """Of Ray."""
    given_at: float = field(default_factory=time.monotonic)
    started_at: float = math.inf
    node: str = ""
    """Where it runs; empty before it has started."""
    cancelled: str = ""
    """Why it has been."""

    @property
    def leases(self) -> list[Lease]:
        return list(chain.from_iterable(self.parts))

    @property
    def memory(self) -> int:
        """How much memory it needs [bytes], which Ray counts where it places calls."""
        meshes = [lease.task.simulation.vertices for lease in self.leases if isinstance(lease.task, SimulateTask)]
        return STAGE_BYTES[self.stage] + VERTEX_BYTES * max(meshes, default=0)

    def limit(self, most: float) -> float:
        """Return how long it may take [s], `most` where that of a task is not known."""
        # Tasks of a part are put together because they are alike: the longest limit is that of all of them.
        return min(most, sum(max(lease.limit_seconds or most for lease in part) for part in self.parts))

    def arguments(self) -> list[Any]:
        """Return what the process is given for each part: the renderer takes dicts, the stages JSON."""
        if self.stage is Stage.render:
            return [merged(_renders(part)).model_dump(mode="json") for part in self.parts]
        return [tasks_adapter.dump_json([lease.task for lease in part]).decode() for part in self.parts]

    def results(self, answers: list[Any]) -> Iterator[TaskResult]:
        """Yield the result of each task from the answers."""
        for answer, part in zip(answers, self.parts, strict=True):
            try:
                if self.stage is Stage.render:
                    yield from split(_renders(part), TaskResult.model_validate(answer))
                else:
                    yield from results_adapter.validate_json(answer)
            except ValidationError as error:
                yield from [failure(error)] * len(part)


def _renders(part: list[Lease]) -> list[RenderTask]:
    return [lease.task for lease in part if isinstance(lease.task, RenderTask)]


class Pace:
    """How long tasks took the last time, and how many a call takes therefore."""

    def __init__(self) -> None:
        self._seconds: dict[Stage, float] = {}
        self._short_renders = 1
        """How many that share no shading are one call. CPU time counts: a busy machine needs no smaller calls."""
        self._renders_share = False
        """Whether the last renders that were leased share shadings."""

    def note(self, one: Call, seconds: float, results: list[TaskResult]) -> None:
        self._seconds[one.stage] = max(seconds / len(results), 1e-3)
        if one.stage is Stage.render:
            cpu = max(sum(result.cpu_seconds for result in results) / len(results), 1e-3)
            self._short_renders = max(min(int(ENOUGH_SECONDS / cpu), MOST_TOGETHER), 1)

    def call(self, stage: Stage) -> float:
        """Return how long a call takes [s]; infinity where that is not known."""
        return self._seconds.get(stage, math.inf) * self.tasks(stage)

    def tasks(self, stage: Stage) -> int:
        if stage is Stage.simulate:
            return LARGEST_BATCH if self._seconds.get(stage, math.inf) < ENOUGH_SECONDS else 1
        if stage is Stage.render:
            return MOST_TOGETHER if self._renders_share else self._short_renders
        return 1

    def ahead(self, stage: Stage) -> int:
        """Return how many calls of a stage should wait here, for each CPU."""
        return round(min(2 * ENOUGH_SECONDS / self.call(stage), MOST_TOGETHER))

    def calls(self, leases: Iterable[Lease], *, is_short: bool) -> Iterator[Call]:
        """Yield the calls that do what has been leased."""
        groups: dict[tuple[Stage, str, int], list[Lease]] = {}
        for lease in leases:
            stage, shared, size = Stage(lease.task.stage), "", 1
            if isinstance(lease.task, SimulateTask):
                shared, size = lease.task.simulation.kind, kind(lease.task.simulation.kind).batch
            if isinstance(lease.task, RenderTask):
                shared = shading_of(lease.task) or ""
                self._renders_share = shared != ""
                size = MOST_TOGETHER if shared else self._short_renders
            groups.setdefault((stage, shared, size), []).append(lease)
        for (stage, shared, size), group in groups.items():
            for start in range(0, len(group), size):
                some = group[start : start + size]
                yield Call(stage, [some] if shared else [[lease] for lease in some], is_short)


def shading_of(task: RenderTask) -> str | None:
    """Return a key that renders of one shading share; None if a render shares none."""
    shared = task.render.shading
    return None if shared is None else canonical_json({"shading": shared, "record": task.record.model_dump()})


def merged(tasks: Sequence[RenderTask]) -> RenderTask:
    """Merge renders of one shading into one task; a single task stays as it is."""
    if len(tasks) == 1:
        return tasks[0]
    if len({shading_of(task) for task in tasks}) != 1 or shading_of(tasks[0]) is None:
        raise ValueError("tasks must be renders of one shading to be merged")
    textures = tuple(dict.fromkeys(task.render.variant for task in tasks))
    return tasks[0].model_copy(update={"textures": textures, "preview": any(task.preview for task in tasks)})


def split(tasks: Sequence[RenderTask], result: TaskResult) -> list[TaskResult]:
    """Split the result of merged renders into one a task; the cost is divided evenly."""
    if len(tasks) == 1:
        return [result]
    share = {"cpu_seconds": result.cpu_seconds / len(tasks), "wall_seconds": result.wall_seconds / len(tasks)}
    if not isinstance(result.output, RenderOutput):
        return [result.model_copy(update=share)] * len(tasks)
    try:
        return [_own(task, result.output.clips[task.render.variant]).model_copy(update=share) for task in tasks]
    except KeyError as error:
        return [failure(error)] * len(tasks)


def _own(task: RenderTask, result: TaskResult) -> TaskResult:
    if task.preview or not isinstance(result.output, RenderOutput):
        return result
    return result.model_copy(update={"output": result.output.model_copy(update={"preview": None})})
