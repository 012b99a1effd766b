"""A square of cloth, dropped on a plane and dragged to and fro [thesis, 4.2.3].

The rig `drag` films it.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from stickslip_schemas.base import Document, Float, Int, Sha256, Stage
from stickslip_schemas.kinds.cloth.arrays import (
    clip_arrays,
    codes,
    fabric_arrays,
    over_time,
    solver_arrays,
)
from stickslip_schemas.kinds.cloth.fabric_axes import with_drawn_material
from stickslip_schemas.kinds.cloth.sensitivities import derivative_arrays, with_derivatives
from stickslip_schemas.kinds.cloth.spec import (
    VIEWPOINT,
    ClipRender,
    ClipSpec,
    Custom,
    LampAxis,
    SubstrateAxis,
    TextureAxis,
    definitions,
)
from stickslip_schemas.scene.parameters import refuse
from stickslip_schemas.spec.arrays import ArrayLayout, array
from stickslip_schemas.spec.axes import (
    SHORTHAND,
    TAGGED,
    LinspaceAxis,
    ListAxis,
    RandomAxis,
    Seed,
    SobolAxis,
    extremes,
    quantity,
)
from stickslip_schemas.spec.cameras import Camera, load_rig, rig_cameras, rig_digest
from stickslip_schemas.spec.fabrics import FABRIC_SHORTHAND, FabricNumbers
from stickslip_schemas.spec.jobs import CONTACT_PROTOCOLS, Costs, PresetName, SeedRule, Simulation
from stickslip_schemas.spec.names import CustomName, Material, name_schema

RIG = "drag"
"""The cameras; their names are also the names of the viewpoints."""

SELF_FRICTION = 0.5
"""Coefficient of friction of a cloth with itself if a spec names none. [Wang et al. 2011]
measured none; this is the middle of the two, of cloth on cloth, with which the thesis simulates
shawls, 0.3 and 0.7 [thesis, Fig. 4.16]."""

VIEWPOINTS = tuple(camera.name for camera in load_rig(RIG))
"""The first is calibrated on the real stage. The last twelve, to test with, are it, turned about
what it looks at by 5, 10 and 15 degrees to all sides [thesis, 4.5.1]. Their order gives the codes
of the label `viewpoint`."""

FRICTION_MAX = 10.0
"""Largest coefficient of friction."""

# Types of values have names of their own, which the JSON schema shows.
Mu = Annotated[
    float, quantity("Mu"), Field(strict=True, ge=0, le=10, description="friction coefficient")
]
StaticRatio = Annotated[
    float,
    quantity("StaticRatio"),
    Field(strict=True, ge=1, le=3, description="static over kinetic coefficient of friction"),
]
Factor = Annotated[
    float,
    quantity("Factor"),
    Field(strict=True, ge=0.1, le=10, description="multiplies the number of the fabric"),
]
MuAxis = Annotated[
    ListAxis[Mu] | LinspaceAxis[Mu] | RandomAxis[Mu] | SobolAxis[Mu], TAGGED, SHORTHAND
]
StaticRatioAxis = Annotated[
    ListAxis[StaticRatio]
    | LinspaceAxis[StaticRatio]
    | RandomAxis[StaticRatio]
    | SobolAxis[StaticRatio],
    TAGGED,
    SHORTHAND,
]
FactorAxis = Annotated[
    ListAxis[Factor] | LinspaceAxis[Factor] | RandomAxis[Factor] | SobolAxis[Factor],
    TAGGED,
    SHORTHAND,
]
MaterialAxis = Annotated[
    ListAxis[Annotated[CustomName, quantity("Material"), name_schema(Material)]],
    FABRIC_SHORTHAND,
]
ViewpointAxis = Annotated[
    ListAxis[Annotated[CustomName, quantity("Viewpoint"), name_schema(VIEWPOINTS)]],
    SHORTHAND,
    VIEWPOINT,
]


class ClothDragAxes(Document):
    """Axes of a clip of dragged cloth."""

    # The physics first, then the looks: the last axis varies fastest, and looks share simulations.
    material: MaterialAxis = Field(
        description="a measured fabric, a custom one under `materials` or in `fabrics/`, or a "
        "distribution that draws many"
    )
    mu: MuAxis = Field(description="friction coefficient between cloth and floor")
    static_ratio: StaticRatioAxis | None = Field(
        default=None,
        description="static over kinetic friction coefficient between cloth and floor; `mu` is "
        "then the kinetic one",
    )
    density: FactorAxis | None = Field(
        default=None, description="factor of the fabric's mass per area"
    )
    bending: FactorAxis | None = Field(
        default=None, description="factor of the fabric's bending rigidity"
    )
    stretching: FactorAxis | None = Field(
        default=None, description="factor of the fabric's stretching stiffness"
    )
    texture: TextureAxis
    viewpoint: ViewpointAxis
    lighting: LampAxis = None
    substrate: SubstrateAxis | None = Field(
        default=None,
        description="finish of the floor, or a custom one under `substrates`; by default `matt`",
    )


DIFFERENTIABLE = ("mu", "density", "bending", "stretching")
"""The axes by which runs may be differentiated. They need no axis in the spec."""

PHYSICAL_AXES = ("material", "mu", "static_ratio", "density", "bending", "stretching")
"""The axes that a trajectory depends on."""


class ClothDragSimulation(Simulation):
    """The trajectory of a dragged cloth: all that it depends on besides the build."""

    kind: Literal["cloth_drag"] = "cloth_drag"
    material: str
    fabric: FabricNumbers | None = Field(
        description="numbers of a custom material; null: a measured one"
    )
    density: float = 1.0
    bending: float = 1.0
    stretching: float = 1.0
    mu: float
    # Left out, the keys of simulations without it are those of builds that did not have it.
    static_ratio: float = Field(default=1.0, exclude_if=lambda ratio: ratio == 1.0)
    preset: PresetName
    mesh: int
    frames: int
    seed: Seed
    self_friction: float | None = Field(description="null: the cloth passes through itself")
    sensitivities: tuple[str, ...] = Field(default=(), exclude_if=lambda names: not names)

    @property
    def vertices(self) -> int:
        return self.mesh**2


class ClothDragRender(ClipRender):
    """How a dragged cloth is seen."""

    kind: Literal["cloth_drag"] = "cloth_drag"
    rig: str
    rig_digest: Sha256
    material: str


class ClothDragSpec(ClipSpec):
    """A square of cloth dropped on a plane and dragged to and fro [thesis, 4.2.3]."""

    simulation_type = ClothDragSimulation
    render_type = ClothDragRender
    # The bias is drawn for each point of the physics, so all renders of it show one trajectory. The
    # light is drawn for each view of it.
    simulation_seeds = (SeedRule("seed", "bias", PHYSICAL_AXES),)
    render_seeds = (
        SeedRule("light_seed", "light", (*PHYSICAL_AXES, "viewpoint", "lighting", "substrate")),
        SeedRule("crease_seed", "creases", PHYSICAL_AXES),
    )
    # Fabrics come first in the order of the axes.
    custom = (
        {"material": Custom("materials", "fabric", tuple(Material))}
        | dict(ClipSpec.custom)
        | {"viewpoint": Custom("viewpoints", "camera", VIEWPOINTS)}
    )
    instants = 300
    instants_per_second = 2.4

    kind: Literal["cloth_drag"]
    axes: ClothDragAxes
    materials: dict[CustomName, FabricNumbers] = definitions("fabrics", "material", at_most=None)
    preset: PresetName = Field(
        default=PresetName.certified,
        description="named solver settings",
        json_schema_extra={
            "x-cost": "`certified` and `fast` have certificates; `fine` takes shorter steps"
        },
    )
    mesh: Int = Field(
        default=41,
        ge=5,
        le=161,
        description="vertices along a side of the square mesh",
        json_schema_extra={
            "x-cost": (
                "CPU time of a dragged cloth, `certified`: 21 takes 4 s, 41 takes 18 s, 81 "
                "takes 2 min"
            )
        },
    )
    self_friction: Float | None = Field(
        default=SELF_FRICTION,
        ge=0,
        le=10,
        description="friction coefficient of the cloth with itself; null turns self-contact off",
        json_schema_extra={
            "x-cost": (
                "1.1 to 1.2 times the CPU time of null, up to 1.7 times where the cloth "
                "folds over itself"
            )
        },
    )

    @model_validator(mode="before")
    @classmethod
    def _draw_fabrics(cls, document: Any) -> Any:
        return with_drawn_material(document)

    @model_validator(mode="after")
    def _static_friction_in_range(self) -> Self:
        ratio = self.axes.static_ratio
        if ratio is None:
            return self
        largest = max(value for _, value in extremes(self.axes.mu))
        for place, value in extremes(ratio):
            if value * largest > FRICTION_MAX:
                rule = f"times the largest mu, {largest:g}, must be at most {FRICTION_MAX:g}"
                refuse(self, ("axes", "static_ratio", *place), rule, value)
        return self

    def key_value(self, axis: str, value: Any) -> Any:
        card = self.materials.get(value) if axis == "material" else None
        return value if card is None else card.identity

    def document_fields(self, axis: str, value: Any) -> dict[str, Any]:
        if axis != "material":
            return super().document_fields(axis, value)
        card = self.materials.get(value)
        numbers = None if card is None else card.numbers()
        return {"material": self.key_value(axis, value), "fabric": numbers}

    @property
    def certified_preset(self) -> str:
        return self.preset.value

    @property
    def certified_protocols(self) -> tuple[str, ...]:
        return () if self.self_friction is None else CONTACT_PROTOCOLS

    @property
    def default_costs(self) -> Costs:
        """CPU times of the packaged records.

        A drag takes 6 s at mesh 21, grows as vertices^1.15, and takes 0.3 to 3 times as much by
        fabric.
        """
        # The presets differ in their time steps. `certified` is 1.
        preset = {PresetName.fast: 0.7, PresetName.fine: 1.7}.get(self.preset, 1.0)
        seconds = 6.0 * preset * (self.mesh / 21) ** 2.3
        # How much of a picture the cloth fills depends on the camera: 0.4 to 0.9 times as much was
        # measured in pictures of 96 to 160 pixels.
        return self.clip_costs(seconds, uncertainty_factor=2.5, render_factor=2.0)

    def cost_group(self, stage: Stage, point: Mapping[str, Any]) -> str:
        """Return the group of samples that cost about the same.

        Simulations group by material, friction to one digit, mesh and preset; renders by their
        clip.
        """
        # A clip costs about the same, whatever it shows.
        if stage is Stage.render:
            return super().cost_group(stage, point)
        card = self.materials.get(point["material"])
        fabric = point["material"] if card is None else card.size_words
        group = f"{fabric}, mu {point['mu']:.1g}, mesh {self.mesh}, {self.preset}"
        if self.self_friction is not None:
            group = f"{group}, self-contact"
        return with_derivatives(group, self)

    def simulation_settings(self) -> dict[str, Any]:
        settings = {"preset": self.preset, "mesh": self.mesh, "frames": self.instants}
        return settings | {
            "self_friction": self.self_friction,
            "sensitivities": self.sensitivities,
        }

    @property
    def differentiable_parameters(self) -> tuple[str, ...]:
        return DIFFERENTIABLE

    def why_not_differentiable(self, name: str) -> str:
        return "is a name" if name == "material" else ""

    def parameter_unit(self, name: str) -> str:
        return "1"

    def render_settings(self) -> dict[str, Any] | None:
        return (super().render_settings() or {}) | {"rig": RIG, "rig_digest": rig_digest(RIG)}

    def cameras(self) -> tuple[Camera, ...]:
        return (
            *rig_cameras(RIG, self.resolution),
            *(camera.camera(name, self.resolution) for name, camera in self.viewpoints.items()),
        )

    def arrays(self) -> tuple[ArrayLayout, ...]:
        # Labels of factors say what their axes say.
        descriptions = {
            name: field.description or "" for name, field in ClothDragAxes.model_fields.items()
        }
        return (
            # Clips and looks, then the physics, its checks, forces and motion.
            *clip_arrays(self),
            codes("material", self.names("material")),
            array("mu", "friction coefficient; the kinetic one where there is `static_ratio`"),
            *(
                array(name, descriptions[name])
                for name in ("static_ratio", "density", "bending", "stretching")
                if name in self.named_axes
            ),
            *fabric_arrays(),
            array(
                "bias_side",
                "side to which gravity leaned during the drop, +1 or -1 along x",
                "int8",
                fill=0,
            ),
            array(
                "landed_side",
                "side of the holders on which the cloth landed, +1 or -1 along x",
                "int8",
                fill=0,
            ),
            array(
                "bias", "what broke the symmetry: horizontal over vertical gravity during the drop"
            ),
            *solver_arrays(self),
            over_time(self, "contact_force", "force of the floor on the cloth [N]", of={"xyz": 3}),
            over_time(self, "holder_force", "force of the holders on the cloth [N]", of={"xyz": 3}),
            *(_mesh(self) if self.store_positions else ()),
        )

    def looks_arrays(self) -> tuple[ArrayLayout, ...]:
        return clip_arrays(self)

    def check_arrays(self) -> tuple[ArrayLayout, ...]:
        return solver_arrays(self)

    @property
    def fixed_bodies(self) -> tuple[dict[str, Any], ...]:
        """The floor, at z = 0."""
        return ({"type": "plane", "normal": [0, 0, 1]},)

    @property
    def held_corners(self) -> tuple[tuple[float, float], ...]:
        """Both ends of the upper edge."""
        return ((-1.0, 1.0), (1.0, 1.0))


def _mesh(spec: ClothDragSpec) -> tuple[ArrayLayout, ...]:
    """Return the mesh and its motion.

    Rest shape and triangles are the same for all samples of a dataset, and every sample has them
    all the same: a repeated row costs some bytes, an array without the dimension `sample` would be
    an exception in every reader.
    """
    # A square of mesh x mesh vertices has two triangles in each cell.
    vertex = {"vertex": spec.mesh**2}
    corners = {"triangle": 2 * (spec.mesh - 1) ** 2, "corner": 3}
    positions = over_time(
        spec,
        "positions",
        "positions of the vertices [m]; the floor is z = 0",
        of=vertex | {"xyz": 3},
        per_sample=True,
        is_trajectory=True,
    )
    return (
        positions,
        *derivative_arrays(spec, {"": positions}),
        array(
            "rest",
            "the flat cloth (warp, weft) [m]",
            "float32",
            vertex | {"uv": 2},
            is_recorded=True,
        ),
        array("triangles", "vertices of the triangles", "int32", corners, is_recorded=True),
    )
