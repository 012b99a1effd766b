"""A square of cloth dropped on a stretched cloth and dragged to and fro [thesis, 4.2.2]."""

from typing import Annotated, Any, Literal

from pydantic import Field

from stickslip_schemas.base.document import Float
from stickslip_schemas.kinds.cloth.drag_scene import DROP_LABELS, Viewpoint, ViewpointName
from stickslip_schemas.kinds.cloth.spec import (
    CUSTOM_LOOKS,
    PHYSICAL_AXES,
    SELF_FRICTION,
    ClothAxes,
    ClothRender,
    ClothSimulation,
    ClothSpec,
    Custom,
    Lighting,
    LightingAxis,
    MaterialAxis,
    MuAxis,
    Substrate,
    TextureAxis,
    codes,
)
from stickslip_schemas.spec.appearance import LampNumbers
from stickslip_schemas.spec.arrays import NAN, ArrayLayout
from stickslip_schemas.spec.axes import SHORTHAND, ListAxis
from stickslip_schemas.spec.fabrics import CustomName, FabricNumbers, Material
from stickslip_schemas.spec.jobs import CONTACT_PROTOCOLS, SeedRule


class ClothOnClothAxes(ClothAxes):
    """What a clip of cloth that is dragged over cloth depends on; `mu` is the friction between the two."""

    mu: MuAxis = Field(description="friction coefficient between the two cloths")
    substrate_material: MaterialAxis = Field(
        description="fabric of the stretched cloth, a measured one, or a custom one under `materials`"
    )
    texture: TextureAxis = Field(
        description="pattern of the cloth, or a custom one under `textures`; the last four are held out for tests"
    )
    viewpoint: Annotated[ListAxis[ViewpointName], SHORTHAND] = Field(
        description="camera of the rig, or a custom one under `viewpoints`"
    )
    lighting: LightingAxis | None = Field(
        default=None, description="range of lamps, or a custom one under `lamps`; by default `drawn`"
    )


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


class ClothOnClothSpec(ClothSpec):
    """A square of cloth dropped on a stretched cloth and dragged to and fro [thesis, 4.2.2]."""

    simulation_type = ClothOnClothSimulation
    render_type = ClothOnClothRender
    simulation_seeds = (SeedRule("seed", "bias", _PHYSICAL_AXES),)
    render_seeds = (
        SeedRule("light_seed", "light", (*_PHYSICAL_AXES, "viewpoint", "lighting")),
        SeedRule("crease_seed", "creases", _PHYSICAL_AXES),
    )
    instants = 300
    instants_per_second = 2.4
    rig = "drag"
    custom = CUSTOM_LOOKS | {
        "substrate_material": Custom("materials", "substrate_fabric", tuple(Material)),
        "viewpoint": Custom("viewpoints", "camera", tuple(Viewpoint)),
        "lighting": Custom("lamps", "lamp", tuple(Lighting)),
    }

    kind: Literal["cloth_on_cloth"]
    axes: ClothOnClothAxes
    self_friction: Float = Field(
        default=SELF_FRICTION, ge=0, le=10, description="friction coefficient of each cloth with itself"
    )
    lamps: dict[CustomName, LampNumbers] = Field(
        default_factory=dict,
        max_length=64,
        description="custom lamps, by the names that the axis `lighting` uses",
        json_schema_extra={"additionalProperties": False},
    )

    @property
    def certified_protocols(self) -> tuple[str, ...]:
        """Those of contact."""
        return CONTACT_PROTOCOLS

    def simulation_settings(self) -> dict[str, Any]:
        """Return the fields of the simulation document that are the same for all samples."""
        return super().simulation_settings() | {"self_friction": self.self_friction}

    def render_settings(self) -> dict[str, Any] | None:
        """Return the fields of the render document that are the same for all samples: a woven floor, for one."""
        return (super().render_settings() or {}) | {"substrate": Substrate.cloth.value}

    def arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the arrays of a dataset of cloth that is dragged over cloth."""
        forces = (
            ("contact_force", "force of the stretched cloth on the cloth [N]"),
            ("holder_force", "force of the holders on the cloth [N]"),
        )
        return (
            *self.clip_arrays(),
            *self.physical_arrays(),
            codes("substrate_material", self.names("substrate_material")),
            *DROP_LABELS,
            ArrayLayout(
                "least_distance",
                "float64",
                (),
                (),
                "of two pieces of cloth that do not hang together, at the ends of all steps of the solver [m]",
                fill=NAN,
            ),
            *self.solver_arrays(),
            *(self.over_time(name, "float32", (3,), ("xyz",), text, fill=NAN) for name, text in forces),
            *self.mesh_arrays(),
        )
