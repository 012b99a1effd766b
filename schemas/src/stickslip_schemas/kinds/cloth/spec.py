"""What the kinds of cloth have in common: materials, presets, clips, and the arrays of a trajectory."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any, ClassVar, NamedTuple, Self

from pydantic import Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from stickslip_schemas.base.document import Bool, Document, Float, Int
from stickslip_schemas.base.keys import ArtifactRef, Sha256, referred
from stickslip_schemas.base.states import Stage
from stickslip_schemas.spec.appearance import CLIP_SIZE, Calibration, FloorNumbers, LampNumbers, shown_frames
from stickslip_schemas.spec.arrays import NAN, ArrayLayout
from stickslip_schemas.spec.axes import SHORTHAND, LinspaceAxis, ListAxis, RandomAxis, Seed, SobolAxis, quantity
from stickslip_schemas.spec.cameras import Camera, load_rig, rig_digest
from stickslip_schemas.spec.fabrics import CustomName, FabricNumbers, Material, Texture, did_you_mean, name_schema
from stickslip_schemas.spec.jobs import JobSpec, Quality, Render, Simulation

Mu = Annotated[float, quantity("Mu"), Field(strict=True, ge=0, le=10, description="friction coefficient")]
Factor = Annotated[
    float, quantity("Factor"), Field(strict=True, ge=0.1, le=10, description="multiplies the number of the fabric")
]


MaterialName = Annotated[CustomName, quantity("Material"), name_schema(Material)]
TextureName = Annotated[CustomName, quantity("Texture"), name_schema(Texture)]

_TAGGED = Field(discriminator="type")
MuAxis = Annotated[ListAxis[Mu] | LinspaceAxis[Mu] | RandomAxis[Mu] | SobolAxis[Mu], _TAGGED, SHORTHAND]
FactorAxis = Annotated[
    ListAxis[Factor] | LinspaceAxis[Factor] | RandomAxis[Factor] | SobolAxis[Factor], _TAGGED, SHORTHAND
]
MaterialAxis = Annotated[ListAxis[MaterialName], SHORTHAND]
TextureAxis = Annotated[ListAxis[TextureName], SHORTHAND]


class Lighting(StrEnum):
    """Named ranges that the lamp of a clip is drawn from.

    Their order gives the codes of the label `lighting`: add new ones at the end.
    """

    drawn = "drawn"
    held_out = "held-out"


class Substrate(StrEnum):
    """Finishes of the floor: matt black, the seven of the thesis (4.2.2), woven cloth, and any of the hard ones.

    Numbers of a finish are drawn within a range. The order gives the codes of the label `substrate`: add new ones at
    the end.
    """

    matt = "matt"
    aluminium = "aluminium"
    aluminium_pet = "aluminium-pet"
    ceramic = "ceramic"
    rough_glass = "rough-glass"
    smooth_glass = "smooth-glass"
    polyester_mirror = "polyester-mirror"
    stainless_steel = "stainless-steel"
    cloth = "cloth"
    any = "any"


class GroundTruth(StrEnum):
    """What can be known of every pixel of a clip without rendering it."""

    depth = "depth"
    segmentation = "segmentation"
    normals = "normals"
    uv = "uv"
    flow = "flow"


SEGMENTS = ("background", "floor", "cloth", "prop")
"""Names of the codes of the array `segmentation`: add new ones at the end."""

LightingName = Annotated[CustomName, quantity("Lighting"), name_schema(Lighting)]
SubstrateName = Annotated[CustomName, quantity("Substrate"), name_schema(Substrate)]
LightingAxis = Annotated[ListAxis[LightingName], SHORTHAND]
SubstrateAxis = Annotated[ListAxis[SubstrateName], SHORTHAND]


class Custom(NamedTuple):
    """Where the spec defines what an axis of names may name besides what is built in."""

    key: str
    """Of the spec: a mapping from the user's names to what they mean."""
    field: str
    """Of the document that takes it."""
    built_in: tuple[str, ...]


SELF_FRICTION = 0.5
"""Coefficient of friction of a cloth with itself where a spec names none. [Wang et al. 2011] measured none; this is the
middle of the two, of cloth on cloth, with which the thesis simulates shawls, 0.3 and 0.7 [thesis, Fig. 4.16]."""

KERNELS = ("baseline", "x86-64-v3", "x86-64-v4")
"""Levels of the solver's kernels, in the order of the codes of the label `kernel`: add new ones at the end."""


class PresetName(StrEnum):
    """Named, frozen sets of solver settings for cloth; the thesis's three are those of its Table 4.2."""

    certified = "certified"
    fast = "fast"
    fine = "fine"
    thesis_high = "thesis-high"
    thesis_low_small_dt = "thesis-low-small-dt"
    thesis_low_big_dt = "thesis-low-big-dt"


CUSTOM_LOOKS = {
    "material": Custom("materials", "fabric", tuple(Material)),
    "texture": Custom("textures", "image", tuple(Texture)),
}
"""What specs of all kinds of cloth may add: see `ClothSpec.custom`."""

PICTURE_DECIBELS = {Quality.preview: 34.8, Quality.draft: 38.9, Quality.standard: 40.9, Quality.high: 43.1}
"""PSNR of the cloth's pixels by quality [dB]: `benchmarks/render_cloth.py` measures it."""


class ClothAxes(Document):
    """What the material of a cloth and its friction may be."""

    material: MaterialAxis = Field(description="a measured fabric, or a custom one under `materials`")
    mu: MuAxis = Field(description="friction coefficient between cloth and floor")
    density: FactorAxis | None = Field(default=None, description="factor of the fabric's mass per area")
    bending: FactorAxis | None = Field(default=None, description="factor of the fabric's bending rigidity")
    stretching: FactorAxis | None = Field(default=None, description="factor of the fabric's stretching stiffness")


PHYSICAL_AXES = ("material", "mu", "density", "bending", "stretching")
"""The axes that a trajectory of dragged cloth depends on."""


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


class ClothRender(Render):
    """How a cloth is seen: all that its clip depends on besides its trajectory and the build.

    Everything but the texture decides on the shading; clips that differ only in their texture share it.
    """

    material: str
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


class ClothSpec(JobSpec):
    """What the specs of all kinds of cloth have in common."""

    variant_axis = "texture"
    instants: ClassVar[int]
    """How many instants of the motion a trajectory holds."""
    instants_per_second: ClassVar[float]
    rig: ClassVar[str]
    """The cameras; their names are those of the viewpoints."""
    custom: ClassVar[Mapping[str, Custom]]
    """By axis of names, what the user may add to it."""

    materials: dict[CustomName, FabricNumbers] = Field(
        default_factory=dict,
        description="custom fabrics, by the names that the axis `material` uses",
        json_schema_extra={"additionalProperties": False},
    )
    textures: dict[CustomName, ArtifactRef] = Field(
        default_factory=dict,
        max_length=64,
        description="custom textures, by the names that the axis `texture` uses: `sha256:` and the digest that "
        "`stickslip upload` prints",
        json_schema_extra={"additionalProperties": False},
    )
    viewpoints: dict[CustomName, Calibration] = Field(
        default_factory=dict,
        max_length=64,
        description="custom cameras, by the names that the axis `viewpoint` uses",
        json_schema_extra={"additionalProperties": False},
    )
    preset: PresetName = Field(
        default=PresetName.certified,
        description="named solver settings",
        json_schema_extra={"x-cost": "`certified` and `fast` have certificates; `fine` takes shorter steps"},
    )
    allow_uncertified: Bool = Field(
        default=False,
        description="make the dataset without a passing certificate of the preset",
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
            "x-cost": "CPU time of a frame and texture: preview 0.04 s, draft 0.07 s, standard 0.10 s, high 0.33 s"
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
    creases: Float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="strength of the fine creases that the renderer adds; 1 is 0.5 mm",
    )

    @property
    def certified_preset(self) -> str:
        """Name of the preset whose certificate vouches for the samples."""
        return self.preset.value

    @property
    def needs_certificate(self) -> bool:
        """True unless the spec allows for the lack of one."""
        return not self.allow_uncertified

    def document_fields(self, axis: str, value: Any) -> dict[str, Any]:
        """Return the fields that a value of an axis sets: what the user has defined brings its numbers along."""
        if axis not in self.custom:
            return {axis: value}
        _, field, _ = self.custom[axis]
        given = self._defined(axis).get(value)
        if isinstance(given, Calibration):
            given = given.camera(value)
        return {axis: value, field: given.model_dump(mode="json") if isinstance(given, Document) else given}

    def _defined(self, axis: str) -> dict[str, Any]:
        defined: dict[str, Any] = getattr(self, self.custom[axis].key)
        return defined

    def names(self, axis: str) -> tuple[str, ...]:
        """Return the names that an axis may use, the built-in ones first: they are the codes of the label."""
        return (*map(str, self.custom[axis].built_in), *self._defined(axis))

    @property
    def artifacts(self) -> dict[str, Sha256]:
        """Pictures of the custom textures."""
        return {f"/textures/{name}": digest for name, image in self.textures.items() if (digest := referred(image))}

    def simulation_settings(self) -> dict[str, Any]:
        """Return the fields of the simulation document that are the same for all samples."""
        return {"preset": self.preset, "mesh": self.mesh, "frames": self.instants}

    def render_settings(self) -> dict[str, Any] | None:
        """Return the fields of the render document that are the same for all samples."""
        return {
            "rig": self.rig,
            "rig_digest": rig_digest(self.rig),
            "quality": self.quality,
            "instants": self.shown_instants,
            "creases": self.creases,
            "ground_truth": self.ground_truth,
        }

    def cameras(self) -> tuple[Camera, ...]:
        """Return the cameras of the viewpoints, by name."""
        return (*load_rig(self.rig), *(own.camera(name) for name, own in self.viewpoints.items()))

    def picture_decibels(self) -> float | None:
        """Return the PSNR of the pictures of this quality, as measured [dB]."""
        return PICTURE_DECIBELS[self.quality]

    def cost_group(self, stage: Stage, point: Mapping[str, Any]) -> str:
        """Return what the cost of a sample hangs on: material, friction to one digit, mesh and preset, or the clip."""
        if stage is Stage.render:
            return f"{self.quality}, {self.frames} frames"
        return f"{point['material']}, mu {point['mu']:.1g}, mesh {self.mesh}, {self.preset}"

    @property
    def shown_instants(self) -> tuple[int, ...]:
        """Which instants of the trajectory the frames of a clip show."""
        return shown_frames(self.frames, self.instants)

    @model_validator(mode="after")
    def _known_names(self) -> Self:
        unknown = []
        for axis, (key, _, built_in) in self.custom.items():
            for name in self._defined(axis):
                if name in built_in:
                    raise ValueError(f"{key} must not redefine what is built in, and {name!r} is")
            known = self.names(axis)
            given = getattr(self.axes, axis)  # type: ignore[attr-defined]  # every kind has axes of its own
            unknown += [
                InitErrorDetails(
                    type=PydanticCustomError(
                        "unknown_name",
                        "Input should be one of {known}{hint}",
                        {"known": ", ".join(known), "hint": did_you_mean(name, known)},
                    ),
                    loc=("axes", axis, "list", "values", position),
                    input=name,
                )
                for position, name in enumerate(() if given is None else given.values)
                if name not in known
            ]
        if unknown:
            raise ValidationError.from_exception_data(type(self).__name__, unknown)
        return self

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

    # --- arrays ---------------------------------------------------------------------------------------------------

    def clip_arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the clip and the labels of what it shows."""
        return (
            ArrayLayout(
                "video",
                "uint8",
                (self.frames, CLIP_SIZE, CLIP_SIZE, 3),
                ("frame", "y", "x", "rgb"),
                "sRGB clip",
                per_sample=True,
                is_clip=True,
                attributes={"instants": list(self.shown_instants)},
            ),
            *self._ground_truth_arrays(),
            codes("texture", self.names("texture")),
            codes("viewpoint", self.names("viewpoint")),
            codes("lighting", self.names("lighting") if "lighting" in self.custom else tuple(Lighting)),
            codes("substrate", self.names("substrate") if "substrate" in self.custom else tuple(Substrate)),
            ArrayLayout("light_seed", "int32", (), (), "seed of the lamp, the floor and the noise", fill=-1),
            ArrayLayout(
                "light",
                "float32",
                (3,),
                ("light",),
                "azimuth and elevation of the lamp [degree], its power over the nominal",
                fill=NAN,
            ),
            ArrayLayout(
                "floor",
                "float32",
                (8,),
                ("floor",),
                "albedo, roughness, metallic, specular and contrast of the marks of the floor, and its tint (rgb)",
                fill=NAN,
            ),
            ArrayLayout("creases", "float32", (), (), "strength of the creases that the renderer added", fill=NAN),
            ArrayLayout(
                "frame_share", "float32", (), (), "share of the frame that is cloth, mean of the clip", fill=NAN
            ),
            ArrayLayout("visible_share", "float32", (), (), "share of the cloth in sight, mean of the clip", fill=NAN),
            ArrayLayout("gate_db", "float32", (), (), "image gate: PSNR of means of 4 x 4 pixels [dB]", fill=NAN),
            ArrayLayout(
                "composed", "bool", (), (), "false where the gate failed and Cycles rendered directly", fill=False
            ),
        )

    def _ground_truth_arrays(self) -> tuple[ArrayLayout, ...]:
        """Return what the spec asks for, of every pixel. Textures share it, and each of their samples has it."""
        frame, axes = (self.frames, CLIP_SIZE, CLIP_SIZE), ("frame", "y", "x")
        known = {
            GroundTruth.depth: ("float32", (), (), "depth along the optical axis [m], infinite where nothing is", NAN),
            GroundTruth.segmentation: ("uint8", (), (), "code of what is seen", 0),
            GroundTruth.normals: (
                "float16",
                (3,),
                ("xyz",),
                "normals towards the camera, in its axes (right, down, forward); 0 where nothing is",
                NAN,
            ),
            GroundTruth.uv: ("float16", (2,), ("uv",), "place on the cloth, 0 to 1 along warp and weft, else NaN", NAN),
            GroundTruth.flow: (
                "float16",
                (2,),
                ("xy",),
                "how far what is seen moves until the next frame of the clip [px], 0 in the last",
                NAN,
            ),
        }
        attributes = {GroundTruth.segmentation: {"categories": list(SEGMENTS)}}
        return tuple(
            ArrayLayout(
                name.value,
                dtype,
                (*frame, *shape),
                (*axes, *dimensions),
                text,
                fill=fill,
                per_sample=True,
                attributes=attributes.get(name, {}),
            )
            for name, (dtype, shape, dimensions, text, fill) in known.items()
            if name in self.ground_truth
        )

    def physical_arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the labels of what the cloth is made of, and its friction."""
        factors = {
            "density": "factor of the fabric's mass per area",
            "bending": "factor of the fabric's rigidity against bending",
            "stretching": "factor of the fabric's stiffness in its plane",
        }
        return (
            codes("material", self.names("material")),
            ArrayLayout("mu", "float64", (), (), "friction coefficient", fill=NAN),
            *(
                ArrayLayout(name, "float64", (), (), text, fill=NAN)
                for name, text in factors.items()
                if name in self.named_axes
            ),
            ArrayLayout("areal_density", "float64", (), (), "mass per area [kg/m^2]", fill=NAN),
            ArrayLayout(
                "bending_rigidity",
                "float64",
                (3,),
                ("direction",),
                "plate rigidities along the warp, along the weft, and of twist [N m]",
                fill=NAN,
            ),
            ArrayLayout(
                "stretching_stiffness",
                "float64",
                (4,),
                ("coefficient",),
                "k0, k1, k2, k3 of [Wang et al. 2011] at no strain [N/m]",
                fill=NAN,
            ),
        )

    def solver_arrays(self) -> tuple[ArrayLayout, ...]:
        """Return what the solver says of its work."""
        return (
            codes("kernel", KERNELS),
            ArrayLayout("steps", "int32", (), (), "time steps of the solver", fill=-1),
            ArrayLayout("unconverged_steps", "int32", (), (), "steps that stopped short of the tolerance", fill=-1),
            ArrayLayout(
                "worst_residual",
                "float64",
                (),
                (),
                "largest residual force of a node in any step, over the weight of a node",
                fill=NAN,
            ),
            self.over_time("self_intersections", "int16", (), (), "pairs of triangles that cross", fill=-1),
        )

    def mesh_arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the mesh and its motion; nothing where the spec does not keep it.

        Rest shape and triangles are the same for all samples of a dataset, and every sample has them all the same: a
        repeated row costs some bytes, an array without the dimension `sample` would be an exception in every reader.
        """
        if not self.store_positions:
            return ()
        vertices, triangles = self.mesh**2, 2 * (self.mesh - 1) ** 2
        return (
            self.over_time(
                "positions",
                "float32",
                (vertices, 3),
                ("vertex", "xyz"),
                "positions of the vertices [m]; the floor is z = 0",
                fill=NAN,
                per_sample=True,
                is_trajectory=True,
            ),
            ArrayLayout(
                "rest",
                "float32",
                (vertices, 2),
                ("vertex", "uv"),
                "the flat cloth (warp, weft) [m]",
                fill=NAN,
                is_recorded=True,
            ),
            ArrayLayout(
                "triangles",
                "int32",
                (triangles, 3),
                ("triangle", "corner"),
                "vertices of the triangles",
                fill=-1,
                is_recorded=True,
            ),
        )

    def over_time(
        self, name: str, dtype: str, shape: tuple[int, ...], dimensions: tuple[str, ...], description: str, **more: Any
    ) -> ArrayLayout:
        """Return an array of the record that has a value of `shape` at each instant."""
        return ArrayLayout(
            name,
            dtype,
            (self.instants, *shape),
            ("instant", *dimensions),
            description,
            is_recorded=True,
            attributes={"instants_per_second": self.instants_per_second},
            **more,
        )


def codes(name: str, names: tuple[str, ...]) -> ArrayLayout:
    """Return the label of an axis of names: a code each, in the order of `names`."""
    return ArrayLayout(name, "int16", (), (), f"code of the {name}", fill=-1, categories=tuple(map(str, names)))
