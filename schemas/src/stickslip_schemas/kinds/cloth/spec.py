"""Specs and documents that the kinds of cloth have in common: materials, presets, clips."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Any, ClassVar, Self

from pydantic import Field, model_validator

from stickslip_schemas.base.document import Bool, Float, Int
from stickslip_schemas.base.keys import ArtifactRef
from stickslip_schemas.base.states import Stage
from stickslip_schemas.kinds.cloth.names import NamingSpec
from stickslip_schemas.spec.appearance import FloorNumbers, LampNumbers, Lighting, Substrate, shown_frames
from stickslip_schemas.spec.axes import Seed
from stickslip_schemas.spec.cameras import Camera
from stickslip_schemas.spec.jobs import Costs, Quality, Render


class GroundTruth(StrEnum):
    """What can be known of every pixel of a clip without rendering it."""

    depth = "depth"
    segmentation = "segmentation"
    normals = "normals"
    uv = "uv"
    flow = "flow"


SEGMENTS = ("background", "floor", "cloth", "prop")
"""Names of the codes of the array `segmentation` of a scene with one cloth: add new ones at the end."""


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


class ClipSpec(NamingSpec):
    """What the specs of all kinds of cloth have in common: clips of trajectories."""

    variant_axis = "texture"
    instants: ClassVar[int]
    """How many instants of the motion a trajectory holds."""
    instants_per_second: ClassVar[float]
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
        default=0.0, ge=0, le=1, description="strength of the fine creases that the renderer adds; 1 is 0.5 mm"
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
