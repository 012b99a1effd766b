"""The document of a scene: `stickslip-scene/1`."""

from collections.abc import Iterator, Mapping
from itertools import combinations_with_replacement
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from stickslip_schemas.base import Document, Float, content_key
from stickslip_schemas.scene.parameters import (
    Location,
    Parameter,
    ParameterName,
    Value,
    refuse,
    refuse_as,
    resolve_path,
    value_at,
    with_values,
)
from stickslip_schemas.scene.parts import (
    BY_NAME,
    Body,
    FileMesh,
    FromFile,
    Looks,
    MeshBody,
    Motion,
    Plane,
    Sheet,
    Time,
    Vector,
)
from stickslip_schemas.spec.jobs import PresetName
from stickslip_schemas.spec.names import CustomName, FabricNumbers, Material, Texture, did_you_mean

MAX_FRAMES = 10_000
"""Of a scene."""
MAX_VERTICES = 100_000
"""Of all sheets of a scene."""
MAX_DOCUMENT_BYTES = 64 * 2**10
"""Of the document of a scene, as JSON."""
MAX_TRACK = 2**31 // 12
"""Vertices times frames of a sheet: a chunk of its positions, in single precision, has at most 2
GiB.
"""

Friction = Annotated[Float, Field(ge=0, le=10)]


class Pair(Document):
    """The friction of two things: two sheets, a sheet and a body, or a sheet with itself."""

    between: tuple[CustomName, CustomName]
    mu: Friction = Field(description="coefficient of friction")


class Bias(Document):
    """A push that breaks symmetry: gravity leans by a horizontal share that the seed draws."""

    size: Float = Field(
        ge=0, le=1, description="most of the horizontal gravity over the vertical, along x and y"
    )
    until: Time = Field(description="when it ends [s]")


class Calm(Document):
    """Damping of all cloth at the beginning, in proportion to its mass."""

    until: Time = Field(description="when it ends [s]")
    rate: Float = Field(ge=0, le=1000, description="[1/s]")


class End(Document):
    """An end that the scene finds itself; arrays go on with the last frame."""

    when: Literal["rest"] = Field(description="all cloth, all holders and all bodies are at rest")
    at_most: Time = Field(gt=0, description="when it ends in any case [s]")


class Physics(Document):
    """All of a scene that its trajectory depends on, besides a seed and the build.

    Lengths are in metres, z is up.
    """

    format: Literal["stickslip-scene/1"]
    duration: Float | None = Field(default=None, gt=0, le=10_000, description="[s]")
    end: End | None = Field(default=None, description="instead of `duration`")
    frame_rate: Float = Field(
        default=30.0, gt=0, le=10_000, description="frames that are kept [1/s]"
    )
    gravity: Vector = Field(default=(0.0, 0.0, -9.81), description="[m/s^2]")
    bias: Bias | None = None
    calm: Calm | None = None
    bearing: Literal["all", "vertices", "first"] = Field(
        default="all",
        description=(
            "who bears friction between sheets: both, vertices on triangles, or the first sheet's"
        ),
    )
    preset: PresetName = Field(default=PresetName.certified, description="named solver settings")
    materials: Annotated[dict[CustomName, FabricNumbers], BY_NAME] = Field(
        default_factory=dict, max_length=64
    )
    sheets: Annotated[dict[CustomName, Sheet], BY_NAME] = Field(min_length=1, max_length=64)
    bodies: Annotated[dict[CustomName, Body], BY_NAME] = Field(default_factory=dict, max_length=64)
    friction: tuple[Pair, ...] = Field(default=(), description="of each two that may touch")
    default_friction: Friction | None = Field(
        default=None,
        description="of pairs that `friction` does not name; null: it must name them all",
    )

    @property
    def frames(self) -> int:
        longest = self.duration if self.end is None else self.end.at_most
        return int((longest or 0.0) * self.frame_rate * (1.0 + 1e-12)) + 1

    @property
    def holders(self) -> tuple[tuple[str, str], ...]:
        """Sheet and name of each holder, in the order of arrays."""
        return tuple(
            (sheet, holder) for sheet, given in self.sheets.items() for holder in given.holders
        )

    def pairs(self) -> Iterator[tuple[str, str]]:
        """Yield each two things that may touch.

        Sheets touch each other, themselves and bodies.
        """
        for one, other in combinations_with_replacement(self.sheets, 2):
            if one != other or self.sheets[one].self_contact:
                yield one, other
        yield from ((sheet, body) for body in self.bodies for sheet in self.sheets)

    def mu(self, one: str, other: str) -> float:
        for pair in self.friction:
            if set(pair.between) == {one, other}:
                return pair.mu
        assert self.default_friction is not None
        return self.default_friction

    def files(self) -> Iterator[tuple[Location, str]]:
        """Yield the files that the physics names: their location in the document, and their name."""
        motions: list[tuple[Location, Motion | None]] = []
        for name, sheet in self.sheets.items():
            if isinstance(sheet.mesh, FileMesh):
                yield ("sheets", name, "mesh", "file"), sheet.mesh.file
            if isinstance(sheet.start, FromFile) and sheet.start.file is not None:
                yield ("sheets", name, "start", "file"), sheet.start.file
            motions += [
                (("sheets", name, "holders", key, "motion"), held.motion)
                for key, held in sheet.holders.items()
            ]
        for name, body in self.bodies.items():
            if isinstance(body, MeshBody):
                yield ("bodies", name, "file"), body.file
            if not isinstance(body, Plane):
                motions.append((("bodies", name, "motion"), body.motion))
        yield from (
            ((*location, "path"), motion.path)
            for location, motion in motions
            if motion and motion.path
        )

    @model_validator(mode="after")
    def _known_materials(self) -> Self:
        for name in self.materials:
            if name in list(Material):
                refuse(self, ("materials", name), "must not redefine what is built in", name)
        known = (*map(str, Material), *self.materials)
        for name, sheet in self.sheets.items():
            if sheet.material not in known:
                hint = did_you_mean(sheet.material, known)
                rule = f"must be one of {', '.join(known)}{hint}"
                refuse(self, ("sheets", name, "material"), rule, sheet.material)
        return self

    @model_validator(mode="after")
    def _within_bounds(self) -> Self:
        if (self.duration is None) == (self.end is None):
            refuse(
                self,
                ("duration",),
                "one of duration [s] and end must be given, and not both",
                self.duration,
            )
        if self.frames > MAX_FRAMES:
            rule = (
                f"length [s] times frame_rate [1/s] must be at most {MAX_FRAMES} frames, and gives "
                f"{self.frames}"
            )
            refuse(self, ("frame_rate",), rule, self.frame_rate)
        vertices = sum(sheet.mesh.shape[0] for sheet in self.sheets.values())
        if vertices > MAX_VERTICES:
            refuse(
                self, ("sheets",), f"must have at most {MAX_VERTICES} vertices together", vertices
            )
        for name, sheet in self.sheets.items():
            if not sheet.self_contact and len(self.sheets) > 1:
                refuse(
                    self,
                    ("sheets", name, "self_contact"),
                    "must be true where there are several sheets",
                    False,
                )
            count = sheet.mesh.shape[0]
            if count * self.frames > MAX_TRACK:
                rule = (
                    f"vertices times frames must be at most {MAX_TRACK}, and there are {count} and "
                    f"{self.frames}"
                )
                refuse(self, ("sheets", name, "mesh"), rule, count * self.frames)
            for key, held in sheet.holders.items():
                if count and held.vertices and max(held.vertices) >= count:
                    location = (
                        "sheets",
                        name,
                        "holders",
                        key,
                        "vertices",
                        held.vertices.index(max(held.vertices)),
                    )
                    refuse(
                        self,
                        location,
                        f"must be a vertex of the sheet, below {count}",
                        max(held.vertices),
                    )
        return self

    @model_validator(mode="after")
    def _friction_of_each_two(self) -> Self:
        if twice := sorted(set(self.sheets) & set(self.bodies)):
            refuse(
                self,
                ("bodies", twice[0]),
                "sheets and bodies must have names of their own",
                twice[0],
            )
        there = {frozenset(pair) for pair in self.pairs()}
        named: set[frozenset[str]] = set()
        for location, pair in enumerate(self.friction):
            two = frozenset(pair.between)
            if two not in there:
                refuse(
                    self,
                    ("friction", location, "between"),
                    "must name two that may touch",
                    list(pair.between),
                )
            if two in named:
                refuse(
                    self,
                    ("friction", location, "between"),
                    "must name two once",
                    list(pair.between),
                )
            named.add(two)
        if self.default_friction is None and (
            missing := sorted(sorted(two) for two in there - named)
        ):
            rule = "must name each two that may touch where there is no default_friction; missing: "
            refuse(self, ("friction",), f"{rule}{missing[0][0]} with {missing[0][-1]}", None)
        return self


class Staged(Physics):
    """A scene whose parameters are set: its physics and its looks."""

    looks: Looks = Looks()

    @property
    def textured(self) -> str:
        """The sheet that takes the axis `texture`: the first without a texture of its own."""
        return next(name for name in self.sheets if name not in self.looks.sheets)

    def files(self) -> Iterator[tuple[Location, str]]:
        """Yield the files that the scene names: their location in the document, and their name."""
        yield from super().files()
        for name, look in self.looks.sheets.items():
            if look.texture not in list(Texture):
                yield ("looks", "sheets", name, "texture"), look.texture

    @model_validator(mode="after")
    def _looks_of_what_is_there(self) -> Self:
        for what in ("sheets", "bodies"):
            there = getattr(self, what)
            for name in getattr(self.looks, what):
                if name not in there:
                    hint = did_you_mean(name, there)
                    refuse(
                        self,
                        ("looks", what, name),
                        f"must be one of {', '.join(there) or 'none'}{hint}",
                        name,
                    )
        if len(self.looks.sheets) == len(self.sheets):
            refuse(
                self,
                ("looks", "sheets"),
                "must leave one sheet to the axis texture",
                list(self.looks.sheets),
            )
        return self


class Scene(Staged):
    """A scene: its physics, its parameters and its looks."""

    name: CustomName | None = Field(default=None, description="of the scene, for people")
    description: str = Field(default="", max_length=2000, description="for people")
    parameters: Annotated[dict[ParameterName, Parameter], BY_NAME] = Field(
        default_factory=dict,
        max_length=32,
        description="what may vary, by the name of its axis and label",
    )

    @property
    def digest(self) -> str:
        return content_key("scene", self.model_dump(mode="json"))

    def staged(self) -> dict[str, Any]:
        """Return the part of the document, as JSON, that pictures depend on."""
        return self.model_dump(mode="json", include=set(Staged.model_fields))

    def physics(self) -> dict[str, Any]:
        """Return the part of the document, as JSON, that a trajectory depends on."""
        return self.model_dump(mode="json", include=set(Physics.model_fields))

    def locations(self, parameter: str) -> tuple[Location, ...]:
        """Return the locations in the document that a parameter sets."""
        document = self.physics()
        return tuple(resolve_path(document, path) for path in self.parameters[parameter].sets)

    def default(self, parameter: str) -> Value:
        """Return the value of a parameter where no axis gives one: what the document says."""
        value: Value = value_at(self.physics(), self.locations(parameter)[0])
        return value

    def physics_with(self, values: Mapping[Location, Any]) -> Physics:
        """Return the physics with other values at locations of the document; raise ValidationError."""
        return Physics.model_validate(with_values(self.physics(), values))

    @model_validator(mode="after")
    def _parameters_fit(self) -> Self:
        document, taken = self.physics(), dict[Location, str]()
        for name, parameter in self.parameters.items():
            parameter.check(self, name, document, taken)
            for end, value in parameter.extremes:
                try:
                    self.physics_with(dict.fromkeys(self.locations(name), value))
                except ValidationError as error:
                    refuse_as(error, self, ("parameters", name, *end), value)
        return self
