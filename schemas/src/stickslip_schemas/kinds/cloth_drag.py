"""A square of cloth dropped on a plane and dragged to and fro [thesis, 4.2.3]."""

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field

from stickslip_schemas.base.document import Float
from stickslip_schemas.base.states import Stage
from stickslip_schemas.kinds.cloth.arrays import clip_arrays, forces, mesh_arrays, physical_arrays, solver_arrays
from stickslip_schemas.kinds.cloth.drag_scene import DROP_LABELS, DragSceneSpec, LampAxis, ViewpointAxis
from stickslip_schemas.kinds.cloth.names import Custom, SubstrateAxis, TextureAxis, definitions
from stickslip_schemas.kinds.cloth.spec import (
    PHYSICAL_AXES,
    SELF_FRICTION,
    ClothAxes,
    ClothRender,
    ClothSimulation,
    seed_rules,
)
from stickslip_schemas.spec.appearance import FloorNumbers, Substrate
from stickslip_schemas.spec.arrays import ArrayLayout
from stickslip_schemas.spec.fabrics import CustomName
from stickslip_schemas.spec.jobs import CONTACT_PROTOCOLS


class ClothDragAxes(ClothAxes):
    """What a clip of dragged cloth depends on."""

    texture: TextureAxis
    viewpoint: ViewpointAxis
    lighting: LampAxis = None
    substrate: SubstrateAxis | None = Field(
        default=None, description="finish of the floor, or a custom one under `substrates`; by default `matt`"
    )


class ClothDragSimulation(ClothSimulation):
    """The trajectory of a dragged cloth: all that it depends on besides the build."""

    kind: Literal["cloth_drag"] = "cloth_drag"
    self_friction: float | None = Field(description="null: the cloth passes through itself")


class ClothDragRender(ClothRender):
    """How a dragged cloth is seen."""

    kind: Literal["cloth_drag"] = "cloth_drag"


class ClothDragSpec(DragSceneSpec):
    """A square of cloth dropped on a plane and dragged to and fro [thesis, 4.2.3]."""

    simulation_type = ClothDragSimulation
    render_type = ClothDragRender
    simulation_seeds, render_seeds = seed_rules(PHYSICAL_AXES, "viewpoint", "lighting", "substrate")
    custom = DragSceneSpec.custom | {"substrate": Custom("substrates", "finish", tuple(Substrate))}

    kind: Literal["cloth_drag"]
    axes: ClothDragAxes
    self_friction: Float | None = Field(
        default=SELF_FRICTION,
        ge=0,
        le=10,
        description="friction coefficient of the cloth with itself; null turns self-contact off",
        json_schema_extra={
            "x-cost": "1.1 to 1.2 times the CPU time of null, up to 1.7 times where the cloth folds over itself"
        },
    )
    substrates: dict[CustomName, FloorNumbers] = definitions("floors", "substrate")

    @property
    def certified_protocols(self) -> tuple[str, ...]:
        """Return the protocols of contact where self-contact is on."""
        return () if self.self_friction is None else CONTACT_PROTOCOLS

    def cost_group(self, stage: Stage, point: Mapping[str, Any]) -> str:
        """Return the group of samples of similar cost; self-contact raises the cost of a simulation."""
        group = super().cost_group(stage, point)
        return f"{group}, self-contact" if stage is Stage.simulate and self.self_friction is not None else group

    def simulation_settings(self) -> dict[str, Any]:
        return super().simulation_settings() | {"self_friction": self.self_friction}

    def arrays(self) -> tuple[ArrayLayout, ...]:
        return (
            *clip_arrays(self),
            *physical_arrays(self),
            *DROP_LABELS,
            *solver_arrays(self),
            *forces(
                self,
                contact_force="force of the floor on the cloth",
                holder_force="force of the holders on the cloth",
            ),
            *mesh_arrays(self),
        )
