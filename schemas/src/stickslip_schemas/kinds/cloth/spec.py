"""Specs and documents that the kinds of cloth have in common: materials, presets, clips."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any, ClassVar, Self

from pydantic import Field, model_validator

from stickslip_schemas.base.document import Bool, Document, Float, Int
from stickslip_schemas.base.keys import ArtifactRef, Sha256
from stickslip_schemas.base.states import Stage
from stickslip_schemas.kinds.cloth.names import MaterialAxis, NamingSpec, definitions
from stickslip_schemas.spec.appearance import FloorNumbers, LampNumbers, Lighting, Substrate, shown_frames
from stickslip_schemas.spec.axes import SHORTHAND, TAGGED, LinspaceAxis, ListAxis, RandomAxis, Seed, SobolAxis, quantity
from stickslip_schemas.spec.cameras import Camera, load_rig, rig_digest
from stickslip_schemas.spec.fabrics import CustomName, FabricNumbers
from stickslip_schemas.spec.jobs import Costs, PresetName, Quality, Render, SeedRule, Simulation

Mu = Annotated[float, quantity("Mu"), Field(strict=True, ge=0, le=10, description="friction coefficient")]
Factor = Annotated[
    float, quantity("Factor"), Field(strict=True, ge=0.1, le=10, description="multiplies the number of the fabric")
]
MuAxis = Annotated[ListAxis[Mu] | LinspaceAxis[Mu] | RandomAxis[Mu] | SobolAxis[Mu], TAGGED, SHORTHAND]
FactorAxis = Annotated[
    ListAxis[Factor] | LinspaceAxis[Factor] | RandomAxis[Factor] | SobolAxis[Factor], TAGGED, SHORTHAND
]


class GroundTruth(StrEnum):
    """What can be known of every pixel of a clip without rendering it."""

    depth = "depth"
    segmentation = "segmentation"
    normals = "normals"
    uv = "uv"
    flow = "flow"


SELF_FRICTION = 0.5
"""Coefficient of friction of a cloth with itself where a spec names none. [Wang et al. 2011] measured none; this is the
middle of the two, of cloth on cloth, with which the thesis simulates shawls, 0.3 and 0.7 [thesis, Fig. 4.16]."""

SEGMENTS = ("background", "floor", "cloth", "prop")
"""Names of the codes of the array `segmentation` of a scene with one cloth: add new ones at the end."""


class ClothAxes(Document):
    """What the material of a cloth and its friction may be."""

    material: MaterialAxis = Field(description="a measured fabric, or a custom one under `materials`")
    mu: MuAxis = Field(description="friction coefficient between cloth and floor")
    density: FactorAxis | None = Field(default=None, description="factor of the fabric's mass per area")
    bending: FactorAxis | None = Field(default=None, description="factor of the fabric's bending rigidity")
    stretching: FactorAxis | None = Field(default=None, description="factor of the fabric's stretching stiffness")


PHYSICAL_AXES = ("material", "mu", "density", "bending", "stretching")
"""The axes that a trajectory of dragged cloth depends on."""


def seed_rules(physical: tuple[str, ...], *seen: str) -> tuple[tuple[SeedRule, ...], tuple[SeedRule, ...]]:
    """Return the seeds of simulations and of renders, from the physical and the visual axes."""
    light = SeedRule("light_seed", "light", (*physical, *seen))
    return (SeedRule("seed", "bias", physical),), (light, SeedRule("crease_seed", "creases", physical))


class ClothSimulation(Simulation):
    """A cloth trajectory: all that it depends on besides the build."""

    material: str
    fabric: FabricNumbers | None = Field(description="numbers of a custom material; null: a measured one")
    density: float = 1.0
    bending: float = 1.0
    stretching: float = 1.0
    mu: float
    preset: PresetName
    mesh: int
    frames: int
    seed: Seed

    @property
    def vertices(self) -> int:
        """How many vertices its square has."""
        return self.mesh**2


class ClipRender(Render):
    """How cloth is seen: all that its clip depends on besides its trajectory and the build.

    Everything but the texture decides on the shading; clips that differ only in their texture share it.
    """

    texture: str
    image: ArtifactRef | None = Field(default=None, description="picture of a custom texture; null: a built-in one")
    viewpoint: str
    camera: Camera | None = Field(default=None, description="of a custom viewpoint; null: a camera of the rig")
    lighting: str = Lighting.drawn.value
    lamp: LampNumbers | None = Field(default=None, description="custom lighting; null: built-in")
    substrate: str = Substrate.matt.value
    finish: FloorNumbers | None = Field(default=None, description="custom substrate; null: a built-in one")
    creases: float = 0.0
    instants: tuple[int, ...] = Field(description="which instants of the trajectory the frames of the clip show")
    ground_truth: tuple[GroundTruth, ...] = ()
    measured: float = 0.0
    light_seed: Seed
    crease_seed: Seed

    @property
    def shading(self) -> dict[str, Any]:
        """What the shading depends on, as JSON: all but the texture."""
        return self.model_dump(mode="json", exclude={"texture", "image"})

    @property
    def variant(self) -> str:
        """The texture, which no shading depends on: a name that is built in, or a reference to a picture."""
        return self.image or self.texture


class ClothRender(ClipRender):
    """How a square of cloth is seen by the cameras of a rig."""

    rig: str
    rig_digest: Sha256
    material: str


class ClipSpec(NamingSpec):
    """What the specs of all kinds of cloth have in common: clips of trajectories."""

    variant_axis = "texture"
    instants: ClassVar[int]
    """How many instants of the motion a trajectory holds."""
    instants_per_second: ClassVar[float]
    allow_uncertified: Bool = Field(
        default=False,
        description="make the dataset without a passing certificate of the preset",
    )
    frames: Int = Field(
        default=30,
        ge=1,
        description="frames of a clip, evenly spread over the instants of the motion",
        json_schema_extra={"x-cost": "rendering time grows with the number of frames"},
    )
    store_positions: Bool = Field(
        default=True,
        description="store the positions of all vertices at all instants",
        json_schema_extra={"x-cost": "1.5 MB a sample at mesh 41"},
    )
    quality: Quality = Field(
        default=Quality.standard,
        description="quality of the pictures",
        json_schema_extra={
            "x-cost": "CPU time of a frame and texture, if eight textures share a shading, without measuring: preview "
            "0.1 s, draft 0.15 s, standard 0.2 s, high 0.5 s; a texture alone at standard 1.6 s"
        },
    )
    ground_truth: tuple[GroundTruth, ...] = Field(
        default=(),
        description="arrays per pixel: any of depth, segmentation, normals, uv, flow",
        json_schema_extra={
            "uniqueItems": True,
            "x-cost": "all five: 3 % more CPU time of rendering, 3.8 MB a sample of 30 frames",
        },
    )
    measured: Float = Field(
        default=0.5,
        ge=0,
        le=10,
        description="cost of measuring how good the clips of eight textures are, over that of rendering them; at "
        "least one frame of each clip is measured, and none at 0",
        json_schema_extra={"x-cost": "at 0.5, half of the CPU time of rendering 30 frames, and more of fewer frames"},
    )
    creases: Float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="strength of the fine creases that the renderer adds; 1 is 0.5 mm",
    )

    @property
    def needs_certificate(self) -> bool:
        """True unless the spec allows for the lack of one."""
        return not self.allow_uncertified

    def render_settings(self) -> dict[str, Any] | None:
        return {
            "quality": self.quality,
            "instants": self.shown_instants,
            "creases": self.creases,
            "ground_truth": self.ground_truth,
            "measured": self.measured,
        }

    def clip_costs(self, simulate: float, unsure: float) -> Costs:
        """Return usual CPU times; measuring the clips of eight textures costs the share `measured` of their shading."""
        shade = {"preview": 0.8, "draft": 1.15, "standard": 1.55, "high": 4.0}[self.quality] * self.frames
        render = 0.01 * self.frames + self.measured * shade / 8
        return Costs(simulate, render, shade, start=2.0, unsure=unsure)

    def cost_group(self, stage: Stage, point: Mapping[str, Any]) -> str:
        """Return what the cost of a sample hangs on."""
        return f"{self.quality}, {self.frames} frames" if stage is Stage.render else ""

    @property
    def segments(self) -> tuple[str, ...]:
        """Names of the codes of the array `segmentation`."""
        return SEGMENTS

    @property
    def shown_instants(self) -> tuple[int, ...]:
        """Which instants of the trajectory the frames of a clip show."""
        return shown_frames(self.frames, self.instants)

    @model_validator(mode="after")
    def _named_once(self) -> Self:
        if len(set(self.ground_truth)) != len(self.ground_truth):
            raise ValueError(f"ground_truth must name each array once; got {', '.join(self.ground_truth)}")
        return self

    @model_validator(mode="after")
    def _frames_there_are(self) -> Self:
        if self.frames > self.instants:
            raise ValueError(f"frames must be at most {self.instants}, the instants of the motion; got {self.frames}")
        return self


class ClothSpec(ClipSpec):
    """What the specs of the kinds of a square of cloth have in common."""

    rig: ClassVar[str]
    """The cameras; their names are those of the viewpoints."""

    materials: dict[CustomName, FabricNumbers] = definitions("fabrics", "material", at_most=None)
    preset: PresetName = Field(
        default=PresetName.certified,
        description="named solver settings",
        json_schema_extra={"x-cost": "`certified` and `fast` have certificates; `fine` takes shorter steps"},
    )
    mesh: Int = Field(
        default=41,
        ge=5,
        le=161,
        description="vertices along a side of the square mesh",
        json_schema_extra={
            "x-cost": "CPU time of a dragged cloth, `certified`: 21 takes 5 s, 41 takes 33 s, 81 takes 5 min"
        },
    )

    @property
    def usual_costs(self) -> Costs:
        """Usual CPU times; a drag takes 8 s at mesh 21, as vertices^1.15, and by fabric 0.3 to 3 times as much."""
        preset = {PresetName.fast: 0.7, PresetName.fine: 1.7}.get(self.preset, 1.0)
        return self.clip_costs(8.0 * preset * (self.mesh / 21) ** 2.3, unsure=3.0)

    @property
    def certified_preset(self) -> str:
        return self.preset.value

    def simulation_settings(self) -> dict[str, Any]:
        return {"preset": self.preset, "mesh": self.mesh, "frames": self.instants}

    def render_settings(self) -> dict[str, Any] | None:
        return (super().render_settings() or {}) | {"rig": self.rig, "rig_digest": rig_digest(self.rig)}

    def cameras(self) -> tuple[Camera, ...]:
        """Return the cameras of the viewpoints, by name."""
        return (*load_rig(self.rig), *(camera.camera(name) for name, camera in self.viewpoints.items()))

    def cost_group(self, stage: Stage, point: Mapping[str, Any]) -> str:
        """Return what the cost of a sample hangs on: material, friction to one digit, mesh and preset, or the clip."""
        if stage is Stage.render:
            return super().cost_group(stage, point)
        return f"{point['material']}, mu {point['mu']:.1g}, mesh {self.mesh}, {self.preset}"
