"""Specs: a `JobSpec` is a parameter grid of one kind.

This module holds the parts that all kinds have in common. A kind itself is one module of
`stickslip_schemas.kinds`.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from functools import cached_property
from itertools import product
from math import prod
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Self, TypeVar

from pydantic import Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from stickslip_schemas.base import (
    Document,
    Float,
    Int,
    Sha256,
    Stage,
    content_key,
    derived_seed,
    replace_at,
)
from stickslip_schemas.spec import arrays
from stickslip_schemas.spec.arrays import COMMON_ARRAYS, ArrayLayout
from stickslip_schemas.spec.axes import MAX_SAMPLES, AnyAxis, ListAxis, Seed, axis_values
from stickslip_schemas.spec.cameras import Camera
from stickslip_schemas.spec.reality import Subject
from stickslip_schemas.spec.resolution import Resolution, resolution_field

D = TypeVar("D", bound=Document)


class StartFault(NamedTuple):
    """One value because of which a sample can never work."""

    location: tuple[str | int, ...]
    """Names, and positions in lists, into the document."""
    rule: str
    """The rule that it breaks, and the remedy."""
    value: Any


class Quality(StrEnum):
    """Named render settings; the renderer has their numbers, and the dataset records them."""

    preview = "preview"
    draft = "draft"
    standard = "standard"
    high = "high"


class PresetName(StrEnum):
    """Named, frozen sets of solver settings for cloth.

    Three are from Table 4.2 of the thesis.
    """

    certified = "certified"
    fast = "fast"
    fine = "fine"
    thesis_high = "thesis-high"
    thesis_low_small_dt = "thesis-low-small-dt"
    thesis_low_big_dt = "thesis-low-big-dt"


CONTACT_PROTOCOLS = ("capstan", "edge", "heavy-fold", "stacked-incline", "pull-out")
"""Protocols that a certificate also needs if cloth touches itself or other cloth."""


class Splits(Document):
    """Fractions of the simulations in each split, or of the clips.

    By simulation, all renders of a simulation fall in one split.
    """

    by: Literal["simulation", "clip"] = Field(
        default="simulation",
        description=(
            "`clip` draws each sample by itself: tests then see simulations that were trained on"
        ),
    )
    train: Float = Field(default=0.8, ge=0, le=1)
    validation: Float = Field(default=0.1, ge=0, le=1)
    test: Float = Field(default=0.1, ge=0, le=1)

    @model_validator(mode="after")
    def _sum_to_one(self) -> Self:
        total = self.train + self.validation + self.test
        if abs(total - 1) > 1e-9:
            raise ValueError(f"train + validation + test must be 1, and they add up to {total:g}")
        return self


class Simulation(Document):
    """All that one trajectory depends on, besides the build.

    Every kind has a class of its own.
    """

    kind: str

    @property
    def artifacts(self) -> tuple[Sha256, ...]:
        """Files in the store that the trajectory is made from."""
        return ()

    @property
    def vertices(self) -> int:
        """How many vertices its meshes have; its memory grows with them."""
        return 0

    def inputs(self, read: Callable[[str], bytes]) -> dict[str, Any]:
        """Return the inputs of the solver, as JSON and arrays.

        `read` returns the bytes of an artifact by its digest.
        """
        return self.model_dump(mode="json", exclude={"kind"})


class Render(Document):
    """All that the pictures of one sample depend on, besides trajectory and renderer build."""

    kind: str
    rig: str | None = Field(description="null: the cameras are of the document or of the sample")
    rig_digest: Sha256 | None
    quality: Quality
    resolution: Resolution = resolution_field("of pictures by cameras of a rig or of the sample")

    @property
    def frame_pixels(self) -> int:
        """How many pixels a frame of a clip has; memory grows with them."""
        return 0

    @property
    def clip_pixels(self) -> int:
        """How many pixels all frames of a clip have together; memory grows with them, too."""
        return 0

    @property
    def artifacts(self) -> tuple[Sha256, ...]:
        """Files in the store that the pictures are made from, besides the variant."""
        return ()

    @property
    def shading(self) -> dict[str, Any] | None:
        """All that renders of one shading share, as JSON; None if none can share it."""
        return None

    @property
    def variant(self) -> str:
        """The value that differs between renders of one shading."""
        return ""


class SeedRule(NamedTuple):
    """A seed that a document draws from the job's seed and from some of the sample's parameters."""

    field: str
    """The field of the document that holds the seed."""
    purpose: str
    """Keeps seeds apart that are drawn from the same parameters."""
    axes: tuple[str, ...] | None
    """The axes whose values enter, as far as the spec has them; None: all axes."""


class Costs(NamedTuple):
    """CPU times [s] of the tasks of a kind, on the machine that the package was measured on.

    Renders share a shading that differ only in the axis of variants.
    """

    simulate: float
    """Of a simulation, in a process that has started."""

    render: float
    """Of a render, once it is shaded."""

    shade: float = 0.0
    """Of a shading."""

    pack: float = 0.001
    """Of a sample that is packed."""

    simulator_start: float = 0.5
    """Of the start of a process that simulates: it imports the solver."""

    renderer_start: float = 2.0
    """Of the start of a process that renders: it imports Blender."""

    uncertainty_factor: float = 2.0
    """80 % of simulations take within this factor of `simulate`."""

    render_factor: float = 1.6
    """80 % of renders take within this factor of their usual time."""


class JobSpec(Document):
    """Base of the specs of all kinds, with all that common code may ask a spec.

    A kind states which documents describe a simulation and a render. A field of these documents
    that has the name of an axis takes its value. `simulation_settings` and `render_settings` give
    the others, and each `SeedRule` draws a seed.
    """

    simulation_type: ClassVar[type[Simulation]]
    render_type: ClassVar[type[Render]]
    simulation_seeds: ClassVar[tuple[SeedRule, ...]] = ()
    render_seeds: ClassVar[tuple[SeedRule, ...]] = ()
    variant_axis: ClassVar[str | None] = None
    subject: ClassVar[Subject | None] = None
    """What measurements are about, to compare with; None if there are none: see `reality`."""
    has_scene: ClassVar[bool] = False
    """True if samples start in a scene, which may be impossible: see `start_faults`."""
    """The axis whose values differ between renders that can be made together, if there is one."""

    # Keys that all kinds have. A kind adds its axes and quality.
    kind: str
    name: str | None = Field(
        default=None,
        pattern=r"^[a-z0-9][a-z0-9-]{0,62}$",
        description="label of the job; enters no key",
    )
    combine: Literal["product", "zip"] = Field(
        default="product",
        description=(
            "product: every combination of the axes; zip: axes of equal length, row by "
            "row; they may repeat"
        ),
    )
    splits: Splits = Field(
        default=Splits(),
        description=(
            "shares of the simulations in each split, with sum 1; `by: clip` draws samples instead"
        ),
    )
    samples_per_shard: Int = Field(
        default=64,
        ge=1,
        le=4096,
        description="samples in one file (shard) of an array",
        json_schema_extra={"x-cost": "larger: fewer files, and a longer wait for the first"},
    )
    seed: Seed = 0

    if TYPE_CHECKING:  # every kind defines these two with its own types, defaults and descriptions
        axes: Document
        quality: Quality

    @property
    def certified_preset(self) -> str:
        """Name of the preset whose certificate vouches for the samples."""
        raise NotImplementedError

    @property
    def needs_certificate(self) -> bool:
        """True if no sample may be made without a passing certificate."""
        raise NotImplementedError

    @property
    def certified_protocols(self) -> tuple[str, ...]:
        """Names of protocols that this certificate must have.

        A certificate without them does not vouch.
        """
        return ()

    def simulation_settings(self) -> dict[str, Any]:
        """Return the fields of the simulation document that are the same for all samples."""
        raise NotImplementedError

    def render_settings(self) -> dict[str, Any] | None:
        """Return the fields of the render document that are the same for all samples.

        None renders nothing.
        """
        raise NotImplementedError

    def arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the arrays of the dataset that only this kind has."""
        raise NotImplementedError

    def cameras(self) -> tuple[Camera, ...]:
        """Return the cameras of the pictures; none if nothing is rendered."""
        raise NotImplementedError

    @property
    def default_costs(self) -> Costs:
        """Usual CPU times of the tasks of this kind."""
        raise NotImplementedError

    def cost_group(self, stage: Stage, point: Mapping[str, Any]) -> str:
        """Return a text that is the same for samples whose `stage` costs about the same.

        Of simulate or render.
        """
        return str(self.quality) if stage is Stage.render else ""

    def fields_of(self, axis: str) -> tuple[str, ...]:
        """Return the fields of documents that an axis sets: by default the field of its name.

        `field/0/name` is a location in a field that holds JSON.
        """
        return (axis,)

    def document_fields(self, axis: str, value: Any) -> dict[str, Any]:
        """Return the values that a value of an axis puts into these fields."""
        return dict.fromkeys(self.fields_of(axis), value)

    def key_value(self, axis: str, value: Any) -> Any:
        """Return what content keys and seeds see of a value of an axis: by default the value."""
        return value

    @property
    def artifacts(self) -> dict[str, Sha256]:
        """Artifacts that must be in the store, by JSON pointers into the spec."""
        return {}

    def scene_place(self, pointer: str) -> tuple[str, ...] | None:
        """Return the location in its scene of an artifact, by its JSON pointer into the spec.

        None if the artifact is a texture.
        """
        return None

    def check_scene_file(self, location: tuple[str, ...], data: bytes) -> None:
        """Raise UnfitFileError if a file does not fit the scene of the spec."""
        raise NotImplementedError

    def start_faults(self, read: Callable[[str], bytes]) -> list[StartFault]:
        """Return why no sample of the spec can ever be valid; empty if one may be.

        Locations are those in the spec. `read` returns the bytes of an artifact by its digest.
        Raises UnfitFileError.
        """
        return []

    def unresolved_files(self) -> dict[str, str]:
        """Return files that the spec gives by name, and not by digest, by JSON pointers."""
        return {}

    # What pages show of a sample. A kind answers, so that common code knows no kind.

    def picture_part(self, point: Mapping[str, Any]) -> tuple[int, int] | None:
        """Return width and height of the picture of a sample in its frames [px].

        None if pictures fill their frames.
        """
        return None

    def looks_arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the arrays that say how the samples look: pictures, cameras, light."""
        return ()

    def check_arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the arrays that say how well the samples were simulated."""
        return ()

    @property
    def fixed_bodies(self) -> tuple[dict[str, Any], ...]:
        """Bodies that no scene describes, for example a floor, as JSON like bodies of a scene."""
        return ()

    @property
    def scene_numbers(self) -> tuple[str, ...]:
        """Names of the labels that are numbers in the scene of a sample."""
        return ()

    def sample_scene(
        self, numbers: Mapping[str, float], read: Callable[[str], bytes]
    ) -> dict[str, Any] | None:
        """Return the scene of a sample as JSON with the arrays of its files; None without one.

        `numbers` are the values of `scene_numbers`; `read` returns an artifact by its digest.
        Raises UnfitFileError.
        """
        return None

    @property
    def held_corners(self) -> tuple[tuple[float, float], ...]:
        """Corners of the flat sheet that are held throughout, by their directions in the sheet."""
        return ()

    @property
    def located_holders(self) -> tuple[int, ...]:
        """Numbers of the holders in `holder_pose` that are at one place; a rim is all around."""
        return ()

    @property
    def named_axes(self) -> dict[str, AnyAxis]:
        """The axes by name, in the order of a product; the last one varies fastest."""
        named = {name: getattr(self.axes, name) for name in type(self.axes).model_fields}
        return {name: axis for name, axis in named.items() if axis is not None}

    @property
    def sample_count(self) -> int:
        """Number of points of the grid."""
        # Zipped axes have one length, and the grid has that many points.
        sizes = [axis.num for axis in self.named_axes.values()]
        return sizes[0] if self.combine == "zip" else prod(sizes)

    @property
    def content_digest(self) -> str:
        """Key of the spec without its name."""
        return content_key("spec", self.model_dump(mode="json", exclude={"name"}))

    @cached_property
    def arrays_digest(self) -> str:
        """Key of the arrays of the dataset.

        It covers their shapes, types, fill values and the names of their codes.
        """
        return content_key("arrays", [array.identity for array in (*self.arrays(), *COMMON_ARRAYS)])

    @property
    def dataset_id(self) -> str:
        """Id of the dataset that answers the spec.

        The same spec has the same dataset, in any build.
        """
        return f"ds-{self.content_digest[:16]}"

    def columns(self) -> list[list[Any]]:
        """Return the values of each axis, in order."""
        # Zipped axes are sampled together, so each takes another dimension of the sequence.
        columns: list[list[Any]] = []
        for position, axis in enumerate(self.named_axes.values()):
            dimension = position if self.combine == "zip" else 0
            columns.append(axis_values(axis, dimension=dimension))
        return columns

    def combined(self, columns: Sequence[Iterable[Any]]) -> Iterator[tuple[Any, ...]]:
        """Combine one column of cells for each axis: all with all, or row by row."""
        return zip(*columns, strict=True) if self.combine == "zip" else product(*columns)

    def grid(self) -> Iterator[dict[str, Any]]:
        """Yield the point of the parameter grid of each sample, in the order of the slots."""
        for point in self.combined(self.columns()):
            yield dict(zip(self.named_axes, point, strict=True))

    def samples_per_file(self, array: ArrayLayout) -> int:
        """Return the number of consecutive samples in every file of an array except the last."""
        # A label is small: its files hold samples of many shards.
        if array.is_label:
            most = max(arrays.LEAST_LABEL_SAMPLES, arrays.LABEL_CHUNK_BYTES // array.sample_bytes)
            return min(most, arrays.LABEL_SAMPLES, self.sample_count)
        return self.samples_per_shard

    def simulation(self, point: Mapping[str, Any]) -> Simulation:
        """Return the simulation at a point of the grid."""
        return self._document(
            self.simulation_type, point, self.simulation_settings(), self.simulation_seeds
        )

    def render(self, point: Mapping[str, Any]) -> Render | None:
        """Return the render at a point of the grid; None renders nothing."""
        settings = self.render_settings()
        return (
            None
            if settings is None
            else self._document(self.render_type, point, settings, self.render_seeds)
        )

    def _document(
        self,
        model: type[D],
        point: Mapping[str, Any],
        settings: dict[str, Any],
        seeds: tuple[SeedRule, ...],
    ) -> D:
        # Values of axes replace settings; a path replaces a value inside of one.
        fields: dict[str, Any] = {}
        for axis, axis_value in point.items():
            for path, value in self.document_fields(axis, axis_value).items():
                name, *inner = path.split("/")
                if name in model.model_fields:
                    fields[name] = replace_at(fields.get(name, settings.get(name)), inner, value)
        drawn: dict[str, int] = {}
        for rule in seeds:
            # A seed depends on values of axes, and not on the slot: a larger grid keeps it.
            values = {axis: self.key_value(axis, point[axis]) for axis in self.seed_axes(rule)}
            drawn[rule.field] = derived_seed(self.seed, rule.purpose, values)
        return model(**{**settings, **fields, **drawn})

    def seed_axes(self, rule: SeedRule) -> tuple[str, ...]:
        """Return the axes of this spec whose values enter a seed."""
        return tuple(axis for axis in self.named_axes if rule.axes is None or axis in rule.axes)

    @model_validator(mode="after")
    def _countable(self) -> Self:
        # A grid that is too large is refused before anybody expands it.
        sizes = {name: axis.num for name, axis in self.named_axes.items()}
        if self.combine == "zip" and len(set(sizes.values())) > 1:
            raise ValueError(f"axes that are zipped must have one length, and theirs are {sizes}")
        for name, axis in self.named_axes.items() if self.combine == "product" else ():
            if isinstance(axis, ListAxis) and len(set(axis.values)) < axis.num:
                twice, _ = Counter(axis.values).most_common(1)[0]
                rule = "values must differ unless axes are zipped, and {twice} is there twice"
                broken = PydanticCustomError("value_error", rule, {"twice": repr(twice)})
                details = InitErrorDetails(type=broken, loc=("axes", name), input=axis.values)
                raise ValidationError.from_exception_data(type(self).__name__, [details])
        if self.sample_count > MAX_SAMPLES:
            raise ValueError(
                f"a job has at most {MAX_SAMPLES} samples, and this one has {self.sample_count}"
            )
        return self
