"""Specs and documents that the kinds of cloth share: names that users add, presets, clips."""

from collections.abc import Callable, Mapping
from enum import StrEnum
from math import ceil, prod
from typing import Annotated, Any, ClassVar, NamedTuple, Self

from pydantic import Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from stickslip_schemas.base import (
    ArtifactRef,
    Bool,
    Document,
    Float,
    Int,
    Sha256,
    Stage,
    artifact_digest,
)
from stickslip_schemas.kinds.cloth import sensitivities
from stickslip_schemas.scene.parameters import ParameterName, refuse
from stickslip_schemas.scene.parts import View
from stickslip_schemas.spec.arrays import shown_frames
from stickslip_schemas.spec.axes import SHORTHAND, ListAxis, Seed, axis_values, quantity
from stickslip_schemas.spec.cameras import Camera
from stickslip_schemas.spec.jobs import Costs, JobSpec, Quality, Render
from stickslip_schemas.spec.names import (
    Calibration,
    CustomName,
    FloorNumbers,
    LampNumbers,
    Lighting,
    Substrate,
    Texture,
    did_you_mean,
    name_schema,
)
from stickslip_schemas.spec.resolution import (
    CLIP_PIXELS_MAX,
    DEFAULT_RESOLUTION,
    Resolution,
    enclosing,
    is_default,
    resolution_field,
)

# Names of axes are checked by `_known_names`, which knows the definitions of the spec. The
# annotations give the JSON schema alone.
VIEWPOINT = Field(description="camera of the rig, or a custom one under `viewpoints`")
TextureAxis = Annotated[
    ListAxis[Annotated[CustomName, quantity("Texture"), name_schema(Texture)]],
    SHORTHAND,
    Field(
        description=(
            "pattern of the cloth, or a custom one under `textures`; the last four are "
            "held out for tests"
        )
    ),
]
LampAxis = Annotated[
    Annotated[
        ListAxis[Annotated[CustomName, quantity("Lighting"), name_schema(Lighting)]], SHORTHAND
    ]
    | None,
    Field(description="range of lamps, or a custom one under `lamps`; by default `drawn`"),
]
SubstrateAxis = Annotated[
    ListAxis[Annotated[CustomName, quantity("Substrate"), name_schema(Substrate)]], SHORTHAND
]


FRAME_COST = 0.1
"""Share of the cost of a shading that is that of the whole frame: fitted to frames of 128 x 128 to
640 x 480 (`benchmarks/clip_psnr.py`)."""


MEASURED_FRAME_COST = 0.75
"""Cost of measuring a frame of up to `MEASURED_TOGETHER` textures, over that of its shading: three
such groups cost 2.25 times the shading (`stickslip_blender.cloth.quality.instants`)."""

MEASURED_TOGETHER = 3
LEAST_MEASURED = 4
"""Textures that are measured together, and frames of a clip that are measured at least."""


class Custom(NamedTuple):
    """Definitions in the spec of names that an axis may use besides built-in ones."""

    key: str
    """Of the spec: a mapping from the user's names to their meaning."""
    field: str
    """Of the document that takes it."""
    built_in: tuple[str, ...]


def definitions(things: str, axis: str, more: str = "", *, at_most: int | None = 64) -> Any:
    """Return the field of a spec that defines custom names of an axis."""
    return Field(
        default_factory=dict,
        max_length=at_most,
        description=f"custom {things}, by the names that the axis `{axis}` uses{more}",
        json_schema_extra={"additionalProperties": False},
    )


class GroundTruth(StrEnum):
    """Quantities that are known of every pixel of a clip without rendering it."""

    depth = "depth"
    segmentation = "segmentation"
    normals = "normals"
    uv = "uv"
    flow = "flow"


SEGMENTS = ("background", "floor", "cloth", "prop")
"""Names of the codes of the array `segmentation` of a scene with one cloth: add new ones at the
end.
"""


class ClipRender(Render):
    """How cloth is seen: all that its clip depends on besides its trajectory and the build.

    Everything but the texture decides on the shading; clips that differ only in their texture share
    it.
    """

    # A name of the user has its meaning beside it; a built-in name has none.
    texture: str
    image: ArtifactRef | None = Field(
        default=None, description="picture of a custom texture; null: a built-in one"
    )
    viewpoint: str
    camera: Camera | None = Field(
        default=None, description="of a custom viewpoint; null: a camera of the rig"
    )
    lighting: str = Lighting.drawn.value
    lamp: LampNumbers | None = Field(default=None, description="custom lighting; null: built-in")
    substrate: str = Substrate.matt.value
    finish: FloorNumbers | None = Field(
        default=None, description="custom substrate; null: a built-in one"
    )
    creases: float = 0.0
    # Which frames are rendered, what is measured on them, and the seeds of light and creases.
    instants: tuple[int, ...] = Field(
        description="which instants of the trajectory the frames of the clip show"
    )
    ground_truth: tuple[GroundTruth, ...] = ()
    measured: float = 0.0
    light_seed: Seed
    crease_seed: Seed
    canvas: Resolution | None = Field(
        default=None,
        exclude_if=lambda size: size is None,
        description="width and height of the frames [px] if pictures of several sizes share a "
        "dataset: a picture is in their upper left; null: frames have the size of the picture",
    )

    @property
    def picture_size(self) -> tuple[int, int]:
        """Width and height of the pictures [px]."""
        return (self.camera.width, self.camera.height) if self.camera else self.resolution

    @property
    def frame_pixels(self) -> int:
        return prod(self.picture_size)

    @property
    def clip_pixels(self) -> int:
        return len(self.instants) * self.frame_pixels

    @property
    def shading(self) -> dict[str, Any]:
        """All that the shading depends on, as JSON: everything but the texture."""
        return self.model_dump(mode="json", exclude={"texture", "image"})

    @property
    def variant(self) -> str:
        """The texture, on which no shading depends.

        It is a built-in name or a reference to a picture.
        """
        return self.image or self.texture


class ClipSpec(JobSpec):
    """Base of the specs of cloth: clips of trajectories, and names that users define."""

    subject = "cloth"
    variant_axis = "texture"
    instants: ClassVar[int]
    """How many instants of the motion a trajectory holds."""
    instants_per_second: ClassVar[float]
    custom: ClassVar[Mapping[str, Custom]] = {
        "texture": Custom("textures", "image", tuple(Texture)),
        "viewpoint": Custom("viewpoints", "camera", ()),
        "lighting": Custom("lamps", "lamp", tuple(Lighting)),
        "substrate": Custom("substrates", "finish", tuple(Substrate)),
    }
    """Definitions that the user may add, by axis of names."""

    # Definitions of names, one mapping for each axis that may use them.
    textures: dict[CustomName, ArtifactRef] = definitions(
        "textures", "texture", ": `sha256:` and the digest that `stickslip upload` prints"
    )
    viewpoints: dict[CustomName, Calibration] = definitions("cameras", "viewpoint")
    lamps: dict[CustomName, LampNumbers] = definitions("lamps", "lighting")
    substrates: dict[CustomName, FloorNumbers] = definitions("floors", "substrate")
    allow_uncertified: Bool = Field(
        default=False, description="make the dataset without a passing certificate of the preset"
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
            "x-cost": "CPU time of a frame and texture, if eight textures share a shading, without "
            "measuring: preview "
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
        description="cost of measuring how good the clips of eight textures are, over that of "
        "rendering them; at "
        "least one frame of each clip is measured, and none at 0",
        json_schema_extra={
            "x-cost": (
                "at 0.5, 60 % of the CPU time of rendering 30 frames, and more of fewer frames"
            )
        },
    )
    resolution: Resolution = resolution_field(
        "width and height of the pictures [px], 64 to 1,920 each; a custom viewpoint may have "
        "another one. Cameras of rigs and of scenes show at least what they show in a square "
        "picture",
        json_schema_extra={
            "x-cost": "CPU time of rendering and sizes of files grow with the number of pixels: "
            "640 x 480 takes 5 times as much as the default, 1,280 x 720 takes 11 times"
        },
    )
    sensitivities: tuple[ParameterName, ...] = sensitivities.names_field()
    creases: Float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="strength of the fine creases that the renderer adds; 1 is 0.5 mm",
    )

    @property
    def needs_certificate(self) -> bool:
        return not self.allow_uncertified

    def render_settings(self) -> dict[str, Any] | None:
        settings = {
            name: getattr(self, name) for name in ("quality", "creases", "ground_truth", "measured")
        }
        sizes = {"resolution": self.resolution, "canvas": self.canvas}
        return settings | sizes | {"instants": self.shown_instants}

    def clip_costs(self, simulate: float, uncertainty_factor: float, render_factor: float) -> Costs:
        """Return CPU times of clips.

        Measuring the clips of eight textures costs the fraction `measured` of their shading, and
        more of clips of few frames, of which `LEAST_MEASURED` are measured.
        """
        # CPU time of shading a frame [s], fitted to `benchmarks/job_costs.py`.
        frame_seconds = {"preview": 0.66, "draft": 0.95, "standard": 1.3, "high": 5.0}
        # Most of it is in the window of the cloth, which grows with the shorter side; the rest is
        # that of the whole frame.
        area = self._mean_over_pictures(prod)
        window = self._mean_over_pictures(lambda size: min(size) ** 2)
        enlargement = (1.0 - FRAME_COST) * window + FRAME_COST * area
        frame = frame_seconds[self.quality] * enlargement
        # Direct renderings of small pictures have up to four times the paths.
        reference = frame_seconds[self.quality] * max(enlargement, min(1.0, 4.0 * enlargement))
        # Measuring the quality of a texture renders some frames again, for up to three at once.
        textures = axis_values(self.named_axes["texture"])
        groups = ceil(len(textures) / MEASURED_TOGETHER) / len(textures)
        measured_frames = 0.0
        if self.measured:
            usual = self.measured * self.frames / (3 * MEASURED_FRAME_COST)
            measured_frames = min(max(usual, LEAST_MEASURED), self.frames)
        render = 0.01 * self.frames * enlargement
        render += measured_frames * MEASURED_FRAME_COST * groups * reference
        return Costs(
            simulate * (1.0 + sensitivities.COST * len(self.sensitivities)),
            render,
            self.frames * frame,
            pack=0.02 * area,
            uncertainty_factor=uncertainty_factor,
            render_factor=render_factor,
        )

    def cost_group(self, stage: Stage, point: Mapping[str, Any]) -> str:
        if stage is not Stage.render:
            return ""
        size = self.picture_size(point["viewpoint"])
        pixels = "" if is_default(size) else f", {size[0]} x {size[1]}"
        return f"{self.quality}, {self.frames} frames{pixels}"

    @property
    def segments(self) -> tuple[str, ...]:
        return SEGMENTS

    def picture_size(self, viewpoint: str) -> tuple[int, int]:
        """Return width and height of the pictures of a viewpoint [px]."""
        meaning = self.meaning("viewpoint", viewpoint)
        # Cameras of a rig, and those that frame what moves, have no definition.
        of_camera = None if meaning is None else meaning.resolution
        return of_camera or self.resolution

    @property
    def _picture_sizes(self) -> tuple[tuple[int, int], ...]:
        """Different sizes of the pictures of a dataset [px]."""
        viewpoints = axis_values(self.named_axes["viewpoint"])
        return tuple(dict.fromkeys(self.picture_size(name) for name in viewpoints))

    @property
    def frame_size(self) -> tuple[int, int]:
        """Width and height of the frames of all clips, the largest of the pictures [px]."""
        return enclosing(self._picture_sizes)

    def _mean_over_pictures(self, measure: Callable[[tuple[int, int]], int]) -> float:
        """Return the mean of a measure of sizes over the pictures, over that of the default."""
        values = [measure(size) for size in self._picture_sizes]
        return sum(values) / len(values) / measure(DEFAULT_RESOLUTION)

    @property
    def canvas(self) -> tuple[int, int] | None:
        """The frame size if pictures of several sizes share it."""
        return self.frame_size if len(self._picture_sizes) > 1 else None

    @property
    def shown_instants(self) -> tuple[int, ...]:
        """Which instants of the trajectory the frames of a clip show."""
        return shown_frames(self.frames, self.instants)

    def picture_part(self, point: Mapping[str, Any]) -> tuple[int, int] | None:
        return self.picture_size(point["viewpoint"]) if self.canvas else None

    def fields_of(self, axis: str) -> tuple[str, ...]:
        return (axis, self.custom[axis].field) if axis in self.custom else (axis,)

    def document_fields(self, axis: str, value: Any) -> dict[str, Any]:
        if axis not in self.custom:
            return {axis: value}
        # The document has the name and its meaning, for two specs may define one name differently.
        meaning = self.meaning(axis, value)
        if isinstance(meaning, Calibration | View):
            meaning = meaning.camera(value, self.resolution)
        return {
            axis: value,
            self.custom[axis].field: meaning.model_dump(mode="json")
            if isinstance(meaning, Document)
            else meaning,
        }

    def _defined(self, axis: str) -> dict[str, Any]:
        defined: dict[str, Any] = getattr(self, self.custom[axis].key)
        return defined

    def built_in(self, axis: str) -> tuple[str, ...]:
        """Return the names that an axis may use without a definition in the spec."""
        return tuple(map(str, self.custom[axis].built_in))

    def meaning(self, axis: str, name: str) -> Any:
        """Return the definition of a name of an axis.

        None if it needs no definition.
        """
        return self._defined(axis).get(name)

    def names(self, axis: str) -> tuple[str, ...]:
        """Return the names that an axis may use, built-in ones first.

        Their order gives the codes of the label.
        """
        return (*self.built_in(axis), *self._defined(axis))

    @property
    def artifacts(self) -> dict[str, Sha256]:
        return {
            f"/textures/{name}": digest
            for name, image in self.textures.items()
            if (digest := artifact_digest(image))
        }

    @model_validator(mode="after")
    def _known_names(self) -> Self:
        # All unknown names are reported at once, so that nobody mends them one by one.
        unknown = []
        for axis in self.custom:
            # A definition that hides a built-in name would change its meaning silently.
            for name in self._defined(axis):
                if name in self.built_in(axis):
                    raise ValueError(
                        f"{self.custom[axis].key} must not redefine what is built in, and {name!r} "
                        "is"
                    )
            # Built-in names and names of the user.
            known = self.names(axis)
            names_axis = getattr(self.axes, axis)
            unknown += [
                InitErrorDetails(
                    type=PydanticCustomError(
                        "unknown_name",
                        "must be one of {known}{hint}",
                        {"known": ", ".join(known), "hint": did_you_mean(name, known)},
                    ),
                    loc=("axes", axis, "list", "values", position),
                    input=name,
                )
                for position, name in enumerate(() if names_axis is None else names_axis.values)
                if name not in known
            ]
        if unknown:
            raise ValidationError.from_exception_data(type(self).__name__, unknown)
        return self

    @model_validator(mode="after")
    def _named_once(self) -> Self:
        if len(set(self.ground_truth)) != len(self.ground_truth):
            raise ValueError(
                f"ground_truth must name each array once; got {', '.join(self.ground_truth)}"
            )
        return self

    def parameter_unit(self, name: str) -> str:
        """Return the unit of a parameter that runs may be differentiated by."""
        raise NotImplementedError

    def why_not_differentiable(self, name: str) -> str:
        """Return why runs cannot be differentiated by a parameter, or an empty text."""
        raise NotImplementedError

    @property
    def differentiable_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that runs may be differentiated by."""
        raise NotImplementedError

    @model_validator(mode="after")
    def _can_be_differentiated(self) -> Self:
        known = self.differentiable_parameters
        for position, name in enumerate(self.sensitivities):
            location = ("sensitivities", position)
            if name not in known:
                reason = self.why_not_differentiable(name)
                rule = f"must be one of {', '.join(known) or 'none'}{did_you_mean(name, known)}"
                refuse(self, location, f"{rule}; {name} {reason}" if reason else rule, name)
            if name in self.sensitivities[:position]:
                refuse(self, location, "must be named once", name)
        if self.sensitivities and not self.store_positions:
            rule = "must be empty if store_positions is false: they are derivatives of positions"
            refuse(self, ("sensitivities",), rule, list(self.sensitivities))
        return self

    @model_validator(mode="after")
    def _lenses_show_their_pictures(self) -> Self:
        # A calibration alone was checked with its own resolution or with the default.
        errors = []
        for name, meaning in self.viewpoints.items():
            try:
                meaning.check_lens(self.resolution)
            except ValueError as error:
                errors.append(
                    InitErrorDetails(
                        type=PydanticCustomError("value_error", "{rule}", {"rule": str(error)}),
                        loc=("viewpoints", name),
                        input=meaning.model_dump(mode="json"),
                    )
                )
        if errors:
            raise ValidationError.from_exception_data(type(self).__name__, errors)
        return self

    @model_validator(mode="after")
    def _frames_there_are(self) -> Self:
        if self.frames > self.instants:
            raise ValueError(
                f"frames must be at most {self.instants}, the instants of the motion; got "
                f"{self.frames}"
            )
        return self

    @model_validator(mode="after")
    def _clip_fits_in_memory(self) -> Self:
        width, height = self.frame_size
        most = CLIP_PIXELS_MAX // (width * height)
        if self.frames > most:
            raise ValueError(
                f"a clip must have at most {CLIP_PIXELS_MAX} pixels in all frames, because its "
                f"shading is held in memory: {self.frames} frames of {width} x {height} have "
                f"{self.frames * width * height}. Set frames to {most} or fewer, or choose a "
                "smaller resolution"
            )
        return self
