"""What a user asks for: a JobSpec is a parameter grid of one kind."""

from enum import StrEnum
from math import prod
from typing import Annotated, Literal, Self

from pydantic import Field, TypeAdapter, model_validator

from stickslip_schemas.axes import (
    MAX_SAMPLES,
    SHORTHAND,
    AnyAxis,
    LinspaceAxis,
    ListAxis,
    RandomAxis,
    Seed,
    SobolAxis,
    quantity,
)
from stickslip_schemas.base import Document
from stickslip_schemas.keys import content_key

Gamma = Annotated[
    float, quantity("Gamma"), Field(strict=True, ge=0, le=1e5, description="weight over bending stiffness")
]
Phi = Annotated[
    float, quantity("Phi"), Field(strict=True, ge=-40, le=40, description="natural curvature times L [rad]")
]
Mu = Annotated[float, quantity("Mu"), Field(strict=True, ge=0, le=10, description="friction coefficient")]


_TAGGED = Field(discriminator="type")
GammaAxis = Annotated[ListAxis[Gamma] | LinspaceAxis[Gamma] | RandomAxis[Gamma] | SobolAxis[Gamma], _TAGGED, SHORTHAND]
PhiAxis = Annotated[ListAxis[Phi] | LinspaceAxis[Phi] | RandomAxis[Phi] | SobolAxis[Phi], _TAGGED, SHORTHAND]
MuAxis = Annotated[ListAxis[Mu] | LinspaceAxis[Mu] | RandomAxis[Mu] | SobolAxis[Mu], _TAGGED, SHORTHAND]


class Material(StrEnum):
    """The ten fabrics measured by [Wang et al. 2011]."""

    black_denim = "11oz-black-denim"
    camel_ponte_roma = "camel-ponte-roma"
    gray_interlock = "gray-interlock"
    ivory_rib_knit = "ivory-rib-knit"
    navy_sparkle_sweat = "navy-sparkle-sweat"
    pink_ribbon_brown = "pink-ribbon-brown"
    royal_target = "royal-target"
    tango_red_jet_set = "tango-red-jet-set"
    white_dots_on_blk = "white-dots-on-blk"
    white_swim_solid = "white-swim-solid"


class Texture(StrEnum):
    """Procedural cloth textures."""

    checker = "checker"
    dots = "dots"
    stripes = "stripes"
    plaid = "plaid"
    gingham = "gingham"
    herringbone = "herringbone"
    houndstooth = "houndstooth"
    floral = "floral"


class Viewpoint(StrEnum):
    """Cameras of the drop-and-drag scene; the first is calibrated on the real stage."""

    calibrated = "calibrated"
    left = "left"
    right = "right"


class Preset(StrEnum):
    """Named, frozen sets of solver settings for cloth; the thesis's three are those of its Table 4.2."""

    certified = "certified"
    fast = "fast"
    thesis_high = "thesis-high"
    thesis_low_small_dt = "thesis-low-small-dt"
    thesis_low_big_dt = "thesis-low-big-dt"


class Quality(StrEnum):
    """Named render settings; their numbers live with the renderer and are recorded in the dataset."""

    draft = "draft"
    standard = "standard"


class Splits(Document):
    """Shares of the simulations in each split; all renders of one simulation fall in the same one."""

    train: float = Field(default=0.8, ge=0, le=1)
    validation: float = Field(default=0.1, ge=0, le=1)
    test: float = Field(default=0.1, ge=0, le=1)

    @model_validator(mode="after")
    def _sum_to_one(self) -> Self:
        total = self.train + self.validation + self.test
        if abs(total - 1) > 1e-9:
            raise ValueError(f"train + validation + test must be 1, and they add up to {total:g}")
        return self


class RodAxes(Document):
    """Non-dimensional parameters of a suspended rod [Bertails-Descoubes et al. 2018]."""

    gamma: GammaAxis
    phi0: PhiAxis
    phi1: PhiAxis


class ClothAxes(Document):
    """What a clip of dragged cloth depends on."""

    material: Annotated[ListAxis[Material], SHORTHAND]
    mu: MuAxis
    texture: Annotated[ListAxis[Texture], SHORTHAND]
    viewpoint: Annotated[ListAxis[Viewpoint], SHORTHAND]


class _JobSpec(Document):
    name: str | None = Field(
        default=None,
        pattern=r"^[a-z0-9][a-z0-9-]{0,62}$",
        description="a word of yours for the job; no part of the content",
    )
    combine: Literal["product", "zip"] = Field(
        default="product",
        description="product: every combination of the axes; zip: the axes have one length and go together",
    )
    splits: Splits = Splits()
    samples_per_shard: int = Field(default=64, ge=1, le=4096)
    seed: Seed = 0

    @property
    def named_axes(self) -> dict[str, AnyAxis]:
        """The axes by name, in the order in which a product is run through (the last one fastest)."""
        axes: Document = self.axes  # type: ignore[attr-defined]  # every kind has its own
        return {name: getattr(axes, name) for name in type(axes).model_fields}

    @property
    def sample_count(self) -> int:
        """Number of samples of the grid."""
        sizes = [axis.num for axis in self.named_axes.values()]
        return sizes[0] if self.combine == "zip" else prod(sizes)

    @property
    def content_digest(self) -> str:
        """Key of what is asked for, whatever it is called."""
        return content_key("spec", self.model_dump(mode="json", exclude={"name"}))

    @model_validator(mode="after")
    def _countable(self) -> Self:
        sizes = {name: axis.num for name, axis in self.named_axes.items()}
        if self.combine == "zip" and len(set(sizes.values())) > 1:
            raise ValueError(f"axes that are zipped must have one length, and theirs are {sizes}")
        if self.sample_count > MAX_SAMPLES:
            raise ValueError(f"a job has at most {MAX_SAMPLES} samples, and this one has {self.sample_count}")
        return self


class RodHangSpec(_JobSpec):
    """Rods that hang from a clamp under their own weight, seen by four cameras."""

    kind: Literal["rod_hang"]
    axes: RodAxes
    poisson: float = Field(default=0.5, gt=-1, le=0.5, description="Poisson's ratio; GJ/EI = 1/(1+nu)")
    views: Literal["rod-4"] | None = Field(default="rod-4", description="camera rig; null renders nothing")
    quality: Quality = Quality.standard


class ClothDragSpec(_JobSpec):
    """A square of cloth dropped on a plane and dragged to and fro [thesis, 4.2.3]."""

    kind: Literal["cloth_drag"]
    axes: ClothAxes
    preset: Preset = Preset.certified
    allow_uncertified: bool = Field(
        default=False,
        description="make the dataset even where no passing certificate vouches for the preset with the workers' build",
    )
    mesh: int = Field(default=41, ge=5, le=161, description="vertices a side")
    frames: int = Field(default=30, ge=1, le=300, description="rendered frames, at regular intervals of 300")
    store_mesh: bool = Field(
        default=True, description="keep the positions of all vertices in all 300 frames, beside the clips"
    )
    quality: Quality = Quality.standard


JobSpec = Annotated[RodHangSpec | ClothDragSpec, Field(discriminator="kind")]

job_spec_adapter: TypeAdapter[RodHangSpec | ClothDragSpec] = TypeAdapter(JobSpec)
"""Validates and dumps a JobSpec of any kind."""
