"""Run tasks in this process. Exceptions become results here, and time is measured here."""

import time
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from stickslip_schemas.base import Reason
from stickslip_schemas.documents.tasks import AnyTask, TaskResult, input_digests, results_adapter, tasks_adapter
from stickslip_schemas.kinds import KINDS
from stickslip_schemas.store import Store, in_parallel, open_store

from stickslip_workers import builds, progress
from stickslip_workers.results import failure


class StageActor:
    """Runs simulate, pack and publish in a process that holds it, with JSON on both sides, as the renderer does."""

    def __init__(self, store: str) -> None:
        self._store = open_store(store)

    def describe(self) -> dict[str, Any]:
        """Return the builds of each kind, and versions of libraries."""
        return {"builds": {name: builds.kind_builds(name) for name in KINDS}, "versions": builds.versions()}

    def run(self, tasks: str) -> str:
        """Run tasks, see `run_tasks`."""
        try:
            return results_adapter.dump_json(run_tasks(tasks_adapter.validate_json(tasks), self._store)).decode()
        finally:
            progress.frames = None

    def frames(self) -> tuple[int, int] | None:
        """Return the progress of the running simulation, (frames done, frames total); another thread may call it."""
        return progress.frames


def run_tasks(tasks: Sequence[AnyTask], store: Store) -> list[TaskResult]:
    """Return one result a task: `tasks` are simulations of one kind, or a single task of another stage.

    The cost of simulations that were solved together is divided among them.
    """
    cpu, wall = time.process_time(), time.perf_counter()
    try:
        results = _run(tasks, store)
    except Exception as error:
        results = [with_damaged_inputs(failure(error), task, store) for task in tasks]
    share = {
        "cpu_seconds": (time.process_time() - cpu) / len(tasks),
        "wall_seconds": (time.perf_counter() - wall) / len(tasks),
    }
    return [result.model_copy(update=share) for result in results]


def with_damaged_inputs(result: TaskResult, task: AnyTask, store: Store) -> TaskResult:
    """Return the result of a failed task with the digests of its damaged inputs, so that they are recomputed at once.

    All inputs are read. While the store is unavailable, they cannot be checked.
    """
    if result.reason is Reason.store_unavailable:
        return result
    digests = input_digests(task, store.read)
    are_whole = in_parallel(store.holds, digests)
    damaged = tuple(digest for digest, is_whole in zip(digests, are_whole, strict=True) if not is_whole)
    return result.model_copy(update={"damaged_inputs": damaged})


def _run(tasks: Sequence[AnyTask], store: Store) -> list[TaskResult]:
    """Call the module of the stage, imported here: packing needs no simulator."""
    (stage,) = {task.stage for task in tasks}
    work = getattr(import_module(f"stickslip_workers.stages.{stage}"), stage)
    if stage == "simulate":
        results: list[TaskResult] = work(tasks, store)
        return results
    return [TaskResult(outcome="succeeded", output=work(task, store)) for task in tasks]
