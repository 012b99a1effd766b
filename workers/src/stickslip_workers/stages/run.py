"""Runs tasks here and now: the one place where exceptions become results, and where time is measured."""

import time
from collections.abc import Sequence
from importlib import import_module

from stickslip_schemas.base.states import Reason
from stickslip_schemas.documents.tasks import PackTask, PublishTask, RenderTask, SimulateTask, TaskResult, input_digests
from stickslip_schemas.store import Store, in_parallel

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
    """Return the result of a failed task with all damaged inputs named, so that they are made again at once.

    Nothing is known of inputs while the store itself cannot be used.
    """
    if result.reason is Reason.store_unavailable:
        return result
    return result.model_copy(update={"damaged_inputs": damaged_inputs(task, store)})


def _failure(error: Exception, task: AnyTask, store: Store) -> TaskResult:
    """Return the result of a task that raised."""
    return with_damaged_inputs(failure(error), task, store)


def _run(tasks: Sequence[AnyTask], store: Store) -> list[TaskResult]:
    """Hand the tasks to the module of their stage, which is imported only now: a packer needs no simulator."""
    (stage,) = {task.stage for task in tasks}
    results: list[TaskResult] = import_module(f"stickslip_workers.stages.{stage}").run(tasks, store)
    return results
