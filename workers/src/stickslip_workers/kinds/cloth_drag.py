"""Dragged cloth: from parameters to the artifact of one trajectory."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from stickslip_schemas.documents.tasks import TaskResult
from stickslip_schemas.store import Store

from stickslip_workers.cloth import drop_labels, fabric_of, forces_of, kernel_level, result_of
from stickslip_workers.kinds import Kind
from stickslip_workers.progress import tell

if TYPE_CHECKING:
    from stickslip_schemas.kinds.cloth_drag import ClothDragSimulation


def _simulate(simulations: Sequence["ClothDragSimulation"], store: Store) -> list[TaskResult]:
    """Simulate one after the other: each takes minutes, and gets an artifact of its own."""
    return [_simulate_one(simulation, store) for simulation in simulations]


def _simulate_one(simulation: "ClothDragSimulation", store: Store) -> TaskResult:
    from stickslip_sim_core.scenes.cloth_drag import drop_and_drag  # here, so that packing needs no compiled core

    fabric = fabric_of(simulation)
    run = drop_and_drag(
        fabric,
        simulation.mu,
        self_friction=simulation.self_friction,
        preset=simulation.preset.value,
        vertices=simulation.mesh,
        frames=simulation.frames,
        seed=simulation.seed,
        on_frame=tell,
    )
    return result_of(simulation, fabric, run, store, record=forces_of(run), labels=drop_labels(run))


KIND = Kind(simulate=_simulate, batch=1, solver="stickslip_sim_core.cloth", kernel=kernel_level)
