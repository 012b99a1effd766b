"""Simulate: trajectories of one kind, by the module of the kind."""

from collections.abc import Sequence

from stickslip_schemas.documents.tasks import SimulateTask, TaskResult
from stickslip_schemas.store import Store

from stickslip_workers.kinds import kind


def run(tasks: Sequence[SimulateTask], store: Store) -> list[TaskResult]:
    """Simulate the tasks together; they must be of one kind."""
    simulations = [task.simulation for task in tasks]
    kinds = sorted({simulation.kind for simulation in simulations})
    if len(kinds) != 1:
        raise ValueError(f"tasks must be simulations of one kind; got {', '.join(kinds)}")
    return kind(kinds[0]).simulate(simulations, store)
