"""Runs tasks here and now: the one place where exceptions become results, and where time is measured."""

import time
from collections.abc import Sequence

from stickslip_schemas.store import Store
from stickslip_schemas.tasks import PackTask, PublishTask, SimulateTask, TaskResult

from stickslip_workers.failures import AnyTask, damaged_inputs, failure
from stickslip_workers.stages.kinds import KINDS
from stickslip_workers.stages.pack import pack
from stickslip_workers.stages.publish import publish


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


def _failure(error: Exception, task: AnyTask, store: Store) -> TaskResult:
    """Return the result of a task that raised; it names all damaged inputs, so that they are made again at once."""
    damaged = damaged_inputs(task, store)
    return failure(error).model_copy(update={"damaged_inputs": damaged})


def _run(tasks: Sequence[AnyTask], store: Store) -> list[TaskResult]:
    simulations = [task.simulation for task in tasks if isinstance(task, SimulateTask)]
    kinds = {simulation.kind for simulation in simulations}
    if len(simulations) == len(tasks) and len(kinds) == 1:
        return KINDS[kinds.pop()].simulate(simulations, store)
    if len(tasks) == 1:
        (task,) = tasks
        if isinstance(task, PackTask):
            return [TaskResult(outcome="succeeded", output=pack(task, store))]
        if isinstance(task, PublishTask):
            return [TaskResult(outcome="succeeded", output=publish(task, store))]
    stages = sorted({str(task.stage) for task in tasks})
    raise ValueError(f"tasks must be simulations of one kind, or one pack or publish; got {len(tasks)} of {stages}")
