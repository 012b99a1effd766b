"""What the kinds of cloth share: from a simulation document to a fabric, and from a run to a record and labels."""

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base.states import Reason
from stickslip_schemas.documents.tasks import RecordRef, SimulateOutput, TaskResult
from stickslip_schemas.store import Store

from stickslip_workers.stages.records import Array, encode_records

if TYPE_CHECKING:  # documents are in the content key as a whole, so the modules that define them are in no build
    from stickslip_schemas.kinds.cloth.spec import ClothSimulation
    from stickslip_schemas.spec.fabrics import FabricNumbers
    from stickslip_sim_core.cloth import Fabric


class ClothRun(Protocol):
    """What a run of any scene of cloth has."""

    @property
    def positions(self) -> npt.NDArray[np.float64]: ...

    @property
    def rest(self) -> npt.NDArray[np.float64]: ...

    @property
    def triangles(self) -> npt.NDArray[np.int32]: ...

    @property
    def self_intersections(self) -> npt.NDArray[np.int32]: ...

    @property
    def steps(self) -> int: ...

    @property
    def unconverged_steps(self) -> int: ...

    @property
    def worst_residual(self) -> float: ...

    @property
    def valid(self) -> bool: ...

    @property
    def reason(self) -> str: ...

    @property
    def kernel(self) -> str: ...


def kernel_level() -> str:
    """Return the level of the kernels that cloth is solved with here: the pinned one, or the widest there is."""
    from stickslip_sim_core._sim_core import cloth_kernels
    from stickslip_sim_core.cloth.solver import KERNEL_VARIABLE

    return os.environ.get(KERNEL_VARIABLE) or cloth_kernels()[-1]


def fabric_of(simulation: "ClothSimulation") -> "Fabric":
    """Return the fabric of a simulation: a measured one or the user's own, times its factors."""
    named = named_fabric(simulation.material, simulation.fabric)
    return named.scaled(density=simulation.density, bending=simulation.bending, stretching=simulation.stretching)


def named_fabric(name: str, numbers: "FabricNumbers | None") -> "Fabric":
    """Return the measured fabric of a name, or the user's own if there are numbers."""
    from stickslip_sim_core.cloth import custom_fabric, fabric

    return fabric(name) if numbers is None else custom_fabric(name, **numbers.model_dump())


class DraggedRun(ClothRun, Protocol):
    """What a run on the stage of drop-and-drag has, too."""

    @property
    def contact_force(self) -> npt.NDArray[np.float64]: ...

    @property
    def holder_force(self) -> npt.NDArray[np.float64]: ...

    @property
    def bias_side(self) -> int: ...

    @property
    def landed_side(self) -> int: ...

    @property
    def bias(self) -> float: ...


def forces_of(run: DraggedRun) -> dict[str, Array]:
    """Return the record of a dragged cloth, beside its trajectory."""
    return {name: np.asarray(getattr(run, name), dtype=np.float32) for name in ("contact_force", "holder_force")}


def drop_labels(run: DraggedRun) -> dict[str, Any]:
    """Return the labels of a drop: see `stickslip_schemas.kinds.cloth.drag_scene`."""
    return {"bias_side": int(run.bias_side), "landed_side": int(run.landed_side), "bias": float(run.bias)}


def result_of(
    simulation: "ClothSimulation",
    fabric: "Fabric",
    run: ClothRun,
    store: Store,
    *,
    record: Mapping[str, Array],
    labels: dict[str, Any],
) -> TaskResult:
    """Return the result of a run: its trajectory, `record` and `labels` beside it, or why it is rejected."""
    if not run.valid:
        return TaskResult(
            outcome="rejected",
            reason=Reason.solver_diverged,
            message=f"{run.reason} at material = {simulation.material}, mu = {simulation.mu:g} with preset "
            f"{simulation.preset}, {simulation.mesh} vertices a side, seed {simulation.seed}",
        )
    arrays: dict[str, Array] = {
        "positions": np.asarray(run.positions, dtype=np.float32),
        "rest": np.asarray(run.rest, dtype=np.float32),
        "triangles": np.asarray(run.triangles, dtype=np.int32),
        "self_intersections": np.minimum(run.self_intersections, np.iinfo(np.int16).max).astype(np.int16),
        **record,
    }
    digest = store.publish(encode_records({name: values[None] for name, values in arrays.items()}))
    common = {
        "areal_density": fabric.density,
        "bending_rigidity": np.diag(fabric.rigidity).tolist(),
        "stretching_stiffness": fabric.stretching[0].tolist(),
        "kernel": run.kernel,
        "steps": int(run.steps),
        "unconverged_steps": int(run.unconverged_steps),
        "worst_residual": float(run.worst_residual),
    }
    output = SimulateOutput(record=RecordRef(digest=digest, row=0), labels=common | labels)
    return TaskResult(outcome="succeeded", output=output)
