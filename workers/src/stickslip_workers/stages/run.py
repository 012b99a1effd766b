"""Runs tasks here and now: the one place where exceptions become results, and where time is measured."""

import time
from collections.abc import Sequence
from importlib import import_module

from stickslip_schemas.store import Store
from stickslip_schemas.tasks import PackTask, PublishTask, RenderTask, SimulateTask, TaskResult

from stickslip_workers.failures import failure

AnyTask = SimulateTask | RenderTask | PackTask | PublishTask


def run_tasks(tasks: Sequence[AnyTask], store: Store) -> list[TaskResult]:
    """Return one result a task: `tasks` are simulations of one kind, or a single task of another stage.

    The cost of simulations that were solved together is divided among them.
    """
    cpu, wall = time.process_time(), time.perf_counter()
    try:
        results = _run(tasks, store)
    except Exception as error:
        results = [failure(error)] * len(tasks)
    share = {
        "cpu_seconds": (time.process_time() - cpu) / len(tasks),
        "wall_seconds": (time.perf_counter() - wall) / len(tasks),
    }
    return [result.model_copy(update=share) for result in results]


def _run(tasks: Sequence[AnyTask], store: Store) -> list[TaskResult]:
    """Hand the tasks to the module of their stage, which is imported only now: a packer needs no simulator."""
    (stage,) = {task.stage for task in tasks}
    results: list[TaskResult] = import_module(f"stickslip_workers.stages.{stage}").run(tasks, store)
    return results
