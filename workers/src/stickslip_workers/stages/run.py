"""Run tasks in this process. Exceptions become results here, and time is measured here."""

import time
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from pydantic import TypeAdapter
from stickslip_schemas.base.states import Reason
from stickslip_schemas.documents.tasks import (
    PackTask,
    PublishTask,
    RenderTask,
    SimulateTask,
    Task,
    TaskResult,
    input_digests,
)
from stickslip_schemas.store import Store, in_parallel, open_store

from stickslip_workers import builds, progress
from stickslip_workers.kinds import kind_names
from stickslip_workers.results import failure

AnyTask = SimulateTask | RenderTask | PackTask | PublishTask

_tasks: TypeAdapter[list[AnyTask]] = TypeAdapter(list[Task])
_results = TypeAdapter(list[TaskResult])


class StageActor:
    """Runs simulate, pack and publish in a process that holds it, with JSON on both sides, as the renderer does."""

    def __init__(self, store: str) -> None:
        self._store = open_store(store)

    def describe(self) -> dict[str, Any]:
        """Return the builds of each kind, and versions of libraries."""
        return {
            "builds": {name: builds.kind_builds(name) for name in kind_names()},
            "versions": builds.versions(),
        }

    def run(self, tasks: str) -> str:
        """Run tasks, see `run_tasks`."""
        progress.clear()
        try:
            return _results.dump_json(run_tasks(_tasks.validate_json(tasks), self._store)).decode()
        finally:
            progress.clear()

    def frames(self) -> tuple[int, int] | None:
        """Return the progress of the running simulation, (frames done, frames total); another thread may call it."""
        return progress.current()


def run_tasks(tasks: Sequence[AnyTask], store: Store) -> list[TaskResult]:
    """Return one result a task: `tasks` are simulations of one kind, or a single task of another stage.

    The cost of simulations that were solved together is divided among them.
    """
    cpu, wall = time.process_time(), time.perf_counter()
    try:
        results = _run(tasks, store)
    except Exception as error:
        results = [_failure(error, task, store) for task in tasks]
    share = {
        "cpu_seconds": (time.process_time() - cpu) / len(tasks),
        "wall_seconds": (time.perf_counter() - wall) / len(tasks),
    }
    return [result.model_copy(update=share) for result in results]


def damaged_inputs(task: AnyTask, store: Store) -> tuple[str, ...]:
    """Return the artifacts that `task` reads and that are damaged or not in the store. Reads all of them."""
    digests = input_digests(task, store.read)
    return tuple(digest for digest, whole in zip(digests, in_parallel(store.holds, digests), strict=True) if not whole)


def with_damaged_inputs(result: TaskResult, task: AnyTask, store: Store) -> TaskResult:
    """Return the result of a failed task with the digests of its damaged inputs, so that they are recomputed at once.

    While the store is unavailable, inputs cannot be checked.
    """
    if result.reason is Reason.store_unavailable:
        return result
    return result.model_copy(update={"damaged_inputs": damaged_inputs(task, store)})


def _failure(error: Exception, task: AnyTask, store: Store) -> TaskResult:
    """Return the result of a task that raised."""
    return with_damaged_inputs(failure(error), task, store)


def _run(tasks: Sequence[AnyTask], store: Store) -> list[TaskResult]:
    """Call the module of the stage, imported here: packing needs no simulator."""
    (stage,) = {task.stage for task in tasks}
    results: list[TaskResult] = import_module(f"stickslip_workers.stages.{stage}").run(tasks, store)
    return results
