"""Cloth on a turning sphere: from parameters to the artifact of one trajectory."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from stickslip_schemas.documents.tasks import TaskResult
from stickslip_schemas.store import Store

from stickslip_workers.cloth import fabric_of, kernel_level, result_of
from stickslip_workers.kinds import Kind
from stickslip_workers.progress import tell

if TYPE_CHECKING:
    from stickslip_schemas.kinds.cloth_sphere import ClothSphereSimulation


def _simulate(simulations: Sequence["ClothSphereSimulation"], store: Store) -> list[TaskResult]:
    """Simulate one after the other: each takes seconds to minutes, and gets an artifact of its own."""
    return [_simulate_one(simulation, store) for simulation in simulations]


def _simulate_one(simulation: "ClothSphereSimulation", store: Store) -> TaskResult:
    from stickslip_sim_core.scenes.cloth_sphere import rotating_sphere  # here, so that packing needs no compiled core

    fabric = fabric_of(simulation)
    run = rotating_sphere(
        fabric,
        simulation.mu,
        speed=simulation.angular_speed,
        preset=simulation.preset.value,
        vertices=simulation.mesh,
        frames=simulation.frames,
        seed=simulation.seed,
        on_frame=tell,
    )
    record = {
        "angle": np.asarray(run.angle, dtype=np.float32),
        "contact_force": np.asarray(run.contact_force, dtype=np.float32),
        "floor_force": np.asarray(run.floor_force, dtype=np.float32),
        "sphere_force": np.asarray(run.sphere_force, dtype=np.float32),
    }
    return result_of(simulation, fabric, run, store, record=record, labels={"bias": list(run.bias)})


KIND = Kind(simulate=_simulate, batch=1, solver="stickslip_sim_core.cloth", kernel=kernel_level)
