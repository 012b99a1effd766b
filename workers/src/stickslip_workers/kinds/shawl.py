"""A shawl over the shoulders of a figure: from parameters to the artifact of one trajectory."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from stickslip_schemas.documents.tasks import TaskResult
from stickslip_schemas.store import Store

from stickslip_workers.cloth import fabric_of, kernel_level, result_of
from stickslip_workers.kinds import Kind
from stickslip_workers.progress import tell
from stickslip_workers.stages.records import Array

if TYPE_CHECKING:
    from stickslip_schemas.kinds.shawl import ShawlSimulation


def _simulate(simulations: Sequence["ShawlSimulation"], store: Store) -> list[TaskResult]:
    """Simulate one after the other: each takes minutes, and gets an artifact of its own."""
    return [_simulate_one(simulation, store) for simulation in simulations]


def _simulate_one(simulation: "ShawlSimulation", store: Store) -> TaskResult:
    from stickslip_sim_core.scenes.shawl import shawl_on_figure  # here, so that packing needs no compiled core

    fabric = fabric_of(simulation)
    run = shawl_on_figure(
        fabric,
        simulation.mu,
        self_friction=simulation.self_friction,
        swing=simulation.swing,
        preset=simulation.preset.value,
        vertices=simulation.mesh,
        frames=simulation.frames,
        seed=simulation.seed,
        on_frame=tell,
    )
    record: dict[str, Array] = {
        name: np.asarray(getattr(run, name), dtype=np.float32)
        for name in ("contact_force", "bones", "skin_rest", "skin_weights")
    }
    record["skin_triangles"] = run.skin_triangles
    labels = {"bias": list(run.bias), "least_distance": float(run.least_distance)}
    return result_of(simulation, fabric, run, store, record=record, labels=labels)


KIND = Kind(simulate=_simulate, batch=1, solver="stickslip_sim_core.cloth", kernel=kernel_level)
