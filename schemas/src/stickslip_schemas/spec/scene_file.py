"""A custom scene, as a file: sheets of cloth, holders and bodies that move, and the friction of each two."""

from collections.abc import Iterator
from itertools import combinations_with_replacement, pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from stickslip_schemas.base.document import Document, Float, Int
from stickslip_schemas.spec.fabrics import CustomName, FabricNumbers, Material
from stickslip_schemas.spec.jobs import PresetName

MAX_FRAMES = 10_000
"""Of a scene."""
MAX_VERTICES = 100_000
"""Of all sheets of a scene."""

Length = Annotated[Float, Field(gt=0, le=100)]
Place = Annotated[Float, Field(ge=-100, le=100)]
Vector = tuple[Place, Place, Place]
Angle = Annotated[Float, Field(ge=-1000, le=1000)]
Turn = tuple[Angle, Angle, Angle]
Friction = Annotated[Float, Field(ge=0, le=10)]
Cells = Annotated[Int, Field(ge=1, le=1000)]


class Key(Document):
    """Where something is at an instant, since the start."""

    time: Float = Field(ge=0, description="[s]")
    move: Vector = Field(default=(0.0, 0.0, 0.0), description="displacement since the start [m]")
    turn: Turn = Field(default=(0.0, 0.0, 0.0), description="rotation since the start, as a rotation vector [rad]")


class Motion(Document):
    """A rigid motion through keyframes: smooth, without overshoot, at rest at its first and its last keyframe."""

    keys: tuple[Key, ...] = Field(min_length=1, max_length=1000)
    about: Vector | None = Field(
        default=None, description="point that turns are about [m]; by default the middle of what moves, at the start"
    )

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        for before, after in pairwise(self.keys):
            if not before.time < after.time:
                raise ValueError(f"keys must ascend in time, and {after.time:g} s comes after {before.time:g} s")
        return self


class Grid(Document):
    """A rectangle, cut into cells, each of two triangles."""

    type: Literal["grid"] = "grid"
    size: tuple[Length, Length] = Field(description="sides along the warp and across [m]")
    cells: tuple[Cells, Cells] = Field(description="cells along both")

    @property
    def vertices(self) -> int:
        """How many vertices it has."""
        return (self.cells[0] + 1) * (self.cells[1] + 1)


class Unstructured(Document):
    """A rectangle of scattered vertices."""

    type: Literal["unstructured"] = "unstructured"
    size: tuple[Length, Length] = Field(description="sides along the warp and across [m]")
    spacing: Length = Field(description="about the length of an edge [m]")
    seed: Int = Field(default=0, ge=0, lt=2**31)

    @property
    def vertices(self) -> int:
        """About how many vertices it has."""
        return int(1.2 * self.size[0] * self.size[1] / self.spacing**2) + 4


class Held(Document):
    """Vertices that a holder holds: those in a rectangle of the flat sheet."""

    low: tuple[Place, Place] = Field(
        description="corner of the rectangle (along the warp, across), from the middle [m]"
    )
    high: tuple[Place, Place] = Field(description="opposite corner [m]")
    motion: Motion | None = Field(default=None, description="of the holder; null: it stays")

    @model_validator(mode="after")
    def _is_a_rectangle(self) -> Self:
        if not (self.low[0] <= self.high[0] and self.low[1] <= self.high[1]):
            raise ValueError(f"low must be at most high in both, and they are {list(self.low)} and {list(self.high)}")
        return self


class Sheet(Document):
    """A piece of cloth, flat at the start."""

    material: CustomName = Field(description="a measured fabric, or a custom one under `materials`")
    mesh: Annotated[Grid | Unstructured, Field(discriminator="type")]
    origin: Vector = Field(description="where its middle starts [m]")
    turn: Turn = Field(
        default=(0.0, 0.0, 0.0),
        description="how it lies, as a rotation vector [rad]; without it the warp is along x and the weft along y",
    )
    thickness: Float = Field(default=5e-4, ge=1e-5, le=0.05, description="[m]")
    holders: dict[CustomName, Held] = Field(default_factory=dict)


class Plane(Document):
    """The half-space below a plane."""

    type: Literal["plane"]
    origin: Vector = (0.0, 0.0, 0.0)
    normal: Vector = (0.0, 0.0, 1.0)

    @model_validator(mode="after")
    def _points_somewhere(self) -> Self:
        if not any(self.normal):
            raise ValueError(f"normal must not be 0, and it is {list(self.normal)}")
        return self


class _Placed(Document):
    origin: Vector = Field(description="where its middle starts [m]")
    turn: Turn = Field(default=(0.0, 0.0, 0.0), description="how it stands at the start, as a rotation vector [rad]")
    motion: Motion | None = Field(default=None, description="null: it stays")


class Sphere(_Placed):
    """A ball."""

    type: Literal["sphere"]
    radius: Length = Field(description="[m]")


class Cylinder(_Placed):
    """A cylinder without ends, whose axis is z before it is turned."""

    type: Literal["cylinder"]
    radius: Length = Field(description="[m]")


class Box(_Placed):
    """A box."""

    type: Literal["box"]
    size: tuple[Length, Length, Length] = Field(description="of its edges [m]")


class MeshBody(Document):
    """Triangles that may move, read from a file beside the scene's."""

    type: Literal["mesh"]
    file: str = Field(min_length=1, max_length=1000, description="an OBJ file, a folder of them, or an NPZ file")
    frame_rate: Float | None = Field(default=None, gt=0, le=10_000, description="of a folder of OBJ files [1/s]")
    thickness: Float = Field(default=5e-4, ge=0, le=0.05, description="of a skin around the triangles [m]")
    motion: Motion | None = Field(default=None, description="that all of it makes besides; null: none")


Body = Annotated[Plane | Sphere | Cylinder | Box | MeshBody, Field(discriminator="type")]


class Pair(Document):
    """The friction of two things: two sheets, a sheet and a body, or a sheet with itself."""

    between: tuple[CustomName, CustomName]
    mu: Friction = Field(description="coefficient of friction")


class SceneFile(Document):
    """A custom scene. Lengths are in metres, z is up."""

    format: Literal["stickslip-scene/1"]
    duration: Float = Field(gt=0, le=10_000, description="[s]")
    frame_rate: Float = Field(default=30.0, gt=0, le=10_000, description="frames that are kept, a second")
    gravity: Vector = Field(default=(0.0, 0.0, -9.81), description="[m/s^2]")
    preset: PresetName = Field(default=PresetName.certified, description="named solver settings")
    materials: dict[CustomName, FabricNumbers] = Field(default_factory=dict, max_length=64)
    sheets: dict[CustomName, Sheet] = Field(min_length=1, max_length=64)
    bodies: dict[CustomName, Body] = Field(default_factory=dict, max_length=64)
    friction: tuple[Pair, ...] = Field(default=(), description="of each two that may touch")
    default_friction: Friction | None = Field(
        default=None, description="of pairs that `friction` does not name; null: it must name them all"
    )

    @property
    def frames(self) -> int:
        """How many frames are kept."""
        return int(self.duration * self.frame_rate * (1.0 + 1e-12)) + 1

    def pairs(self) -> Iterator[tuple[str, str]]:
        """Yield each two that may touch: sheets with each other and with themselves, and sheets with bodies."""
        yield from combinations_with_replacement(self.sheets, 2)
        yield from ((sheet, body) for body in self.bodies for sheet in self.sheets)

    def mu(self, one: str, other: str) -> float:
        """Return the friction of two that may touch."""
        for pair in self.friction:
            if set(pair.between) == {one, other}:
                return pair.mu
        assert self.default_friction is not None
        return self.default_friction

    @model_validator(mode="after")
    def _known_materials(self) -> Self:
        for name in self.materials:
            if name in list(Material):
                raise ValueError(f"materials must not redefine what is built in, and {name!r} is")
        for name, sheet in self.sheets.items():
            known = (*map(str, Material), *self.materials)
            if sheet.material not in known:
                raise ValueError(f"sheets.{name}.material must be one of {', '.join(known)}, got {sheet.material!r}")
        return self

    @model_validator(mode="after")
    def _within_bounds(self) -> Self:
        if self.frames > MAX_FRAMES:
            raise ValueError(
                f"duration times frame_rate must be at most {MAX_FRAMES} frames, and they are {self.frames}"
            )
        vertices = sum(sheet.mesh.vertices for sheet in self.sheets.values())
        if vertices > MAX_VERTICES:
            raise ValueError(f"sheets must have at most {MAX_VERTICES} vertices, and they have about {vertices}")
        return self

    @model_validator(mode="after")
    def _friction_of_each_two(self) -> Self:
        if twice := sorted(set(self.sheets) & set(self.bodies)):
            raise ValueError(f"sheets and bodies must have names of their own, and {twice[0]!r} is both")
        there = {frozenset(pair) for pair in self.pairs()}
        named: set[frozenset[str]] = set()
        for place, pair in enumerate(self.friction):
            two = frozenset(pair.between)
            if two not in there:
                raise ValueError(f"friction.{place}.between must name two that may touch, got {list(pair.between)}")
            if two in named:
                raise ValueError(f"friction.{place}.between must name two once, got {list(pair.between)} again")
            named.add(two)
        if self.default_friction is None and (missing := sorted(sorted(two) for two in there - named)):
            raise ValueError(
                "friction must name each two that may touch, or default_friction must be given, and "
                f"{missing[0][0]} with {missing[0][-1]} is not there"
            )
        for name, body in self.bodies.items():
            mus = {self.mu(sheet, name) for sheet in self.sheets}
            if len(mus) > 1 and not isinstance(body, MeshBody):
                raise ValueError(
                    f"friction of {name}, a {body.type}, must be the same with all sheets, got "
                    f"{', '.join(f'{mu:g}' for mu in sorted(mus))}; a body of type mesh may have one with each"
                )
        return self
