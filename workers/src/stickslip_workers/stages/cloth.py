"""Dragged cloth: from parameters to the artifact of one trajectory."""

from collections.abc import Sequence

import numpy as np
from stickslip_schemas.states import Reason
from stickslip_schemas.store import Store
from stickslip_schemas.tasks import ClothSimulation, RecordRef, SimulateOutput, TaskResult

from stickslip_workers.stages.records import Array, encode_records

RECORD_ARRAYS = ("mesh", "rest", "triangles", "self_intersections", "contact_force", "holder_force")
"""What a record holds, under the names of the dataset."""


def simulate_cloths(simulations: Sequence[ClothSimulation], store: Store) -> list[TaskResult]:
    """Simulate one after the other: each takes minutes, and gets an artifact of its own."""
    return [_simulate(simulation, store) for simulation in simulations]


def _simulate(cloth: ClothSimulation, store: Store) -> TaskResult:
    from stickslip_sim_core import drop_and_drag  # here, so that packing needs no compiled core

    run = drop_and_drag(
        cloth.material.value,
        cloth.mu,
        preset=cloth.preset.value,
        vertices=cloth.mesh,
        frames=cloth.frames,
        seed=cloth.seed,
    )
    if not run.valid:
        return TaskResult(
            outcome="rejected",
            reason=Reason.solver_diverged,
            message=f"{run.reason} at material = {cloth.material}, mu = {cloth.mu:g} with preset {cloth.preset}, "
            f"{cloth.mesh} vertices a side, seed {cloth.seed}",
        )
    record: dict[str, Array] = {
        "mesh": np.asarray(run.positions, dtype=np.float32),
        "rest": np.asarray(run.rest, dtype=np.float32),
        "triangles": np.asarray(run.triangles, dtype=np.int32),
        "self_intersections": np.minimum(run.self_intersections, np.iinfo(np.int16).max).astype(np.int16),
        "contact_force": np.asarray(run.contact_force, dtype=np.float32),
        "holder_force": np.asarray(run.holder_force, dtype=np.float32),
    }
    digest = store.publish(encode_records({name: values[None] for name, values in record.items()}))
    labels = {
        "side": int(run.side),
        "bias": float(run.bias),
        "steps": int(run.steps),
        "unconverged_steps": int(run.unconverged_steps),
        "worst_residual": float(run.worst_residual),
    }
    return TaskResult(outcome="succeeded", output=SimulateOutput(record=RecordRef(digest=digest, row=0), labels=labels))
