"""A square of cloth dropped on a stretched cloth and dragged to and fro [thesis, 4.2.2]."""

from typing import Any, Literal

from pydantic import Field

from stickslip_schemas.base.document import Float
from stickslip_schemas.kinds.cloth.arrays import (
    clip_arrays,
    codes,
    forces,
    mesh_arrays,
    physical_arrays,
    solver_arrays,
)
from stickslip_schemas.kinds.cloth.drag_scene import DROP_LABELS, DragSceneSpec, LampAxis, ViewpointAxis
from stickslip_schemas.kinds.cloth.names import Custom, MaterialAxis, TextureAxis
from stickslip_schemas.kinds.cloth.spec import (
    PHYSICAL_AXES,
    SELF_FRICTION,
    ClothAxes,
    ClothRender,
    ClothSimulation,
    MuAxis,
    seed_rules,
)
from stickslip_schemas.spec.appearance import Substrate
from stickslip_schemas.spec.arrays import ArrayLayout, array
from stickslip_schemas.spec.fabrics import FabricNumbers, Material
from stickslip_schemas.spec.jobs import CONTACT_PROTOCOLS


class ClothOnClothAxes(ClothAxes):
    """What a clip of cloth that is dragged over cloth depends on; `mu` is the friction between the two."""

    mu: MuAxis = Field(description="friction coefficient between the two cloths")
    substrate_material: MaterialAxis = Field(
        description="fabric of the stretched cloth, a measured one, or a custom one under `materials`"
    )
    texture: TextureAxis
    viewpoint: ViewpointAxis
    lighting: LampAxis = None


_PHYSICAL_AXES = (*PHYSICAL_AXES, "substrate_material")


class ClothOnClothSimulation(ClothSimulation):
    """The trajectory of a cloth that is dragged over cloth: all that it depends on besides the build."""

    kind: Literal["cloth_on_cloth"] = "cloth_on_cloth"
    substrate_material: str
    substrate_fabric: FabricNumbers | None = Field(
        description="numbers of a custom stretched cloth; null: a measured one"
    )
    self_friction: float


class ClothOnClothRender(ClothRender):
    """How a cloth that is dragged over cloth is seen."""

    kind: Literal["cloth_on_cloth"] = "cloth_on_cloth"


class ClothOnClothSpec(DragSceneSpec):
    """A square of cloth dropped on a stretched cloth and dragged to and fro [thesis, 4.2.2]."""

    simulation_type = ClothOnClothSimulation
    render_type = ClothOnClothRender
    simulation_seeds, render_seeds = seed_rules(_PHYSICAL_AXES, "viewpoint", "lighting")
    custom = DragSceneSpec.custom | {"substrate_material": Custom("materials", "substrate_fabric", tuple(Material))}

    kind: Literal["cloth_on_cloth"]
    axes: ClothOnClothAxes
    self_friction: Float = Field(
        default=SELF_FRICTION, ge=0, le=10, description="friction coefficient of each cloth with itself"
    )

    @property
    def certified_protocols(self) -> tuple[str, ...]:
        """Return the protocols of contact."""
        return CONTACT_PROTOCOLS

    def simulation_settings(self) -> dict[str, Any]:
        """Return the fields of the simulation document that are the same for all samples."""
        return super().simulation_settings() | {"self_friction": self.self_friction}

    def render_settings(self) -> dict[str, Any] | None:
        """Return the fields of the render document that are the same for all samples: a woven floor, for one."""
        return (super().render_settings() or {}) | {"substrate": Substrate.cloth.value}

    def arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the arrays of a dataset of cloth that is dragged over cloth."""
        return (
            *clip_arrays(self),
            *physical_arrays(self),
            codes("substrate_material", self.names("substrate_material")),
            *DROP_LABELS,
            array(
                "least_distance",
                "of two pieces of cloth that do not hang together, at the ends of all steps of the solver [m]",
            ),
            *solver_arrays(self),
            *forces(
                self,
                contact_force="force of the stretched cloth on the cloth",
                holder_force="force of the holders on the cloth",
            ),
            *mesh_arrays(self),
        )
