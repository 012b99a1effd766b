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
    LARGEST,
    SMALLEST,
    Body,
    FileMesh,
    FromFile,
    Hung,
    Looks,
    MeshBody,
    Motion,
    Plane,
    Sheet,
    Time,
    Vector,
    unit_hint,
)
from stickslip_schemas.spec.fabrics import FabricNumbers
from stickslip_schemas.spec.jobs import PresetName
from stickslip_schemas.spec.names import CustomName, Material, Texture, did_you_mean

MAX_FRAMES = 10_000
"""Of a scene."""
MAX_VERTICES = 100_000
"""Of all sheets of a scene."""
MAX_MATERIALS = 256
"""Most custom fabrics of a scene."""
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
    mu: Friction | None = Field(
        default=None,
        exclude_if=lambda mu: mu is None,
        description="coefficient of friction, at rest and sliding; or `static` and `kinetic`",
    )
    static: Friction | None = Field(
        default=None,
        exclude_if=lambda mu: mu is None,
        description="coefficient of friction up to which what rests holds, `kinetic` or more",
    )
    kinetic: Friction | None = Field(
        default=None,
        exclude_if=lambda mu: mu is None,
        description="coefficient of friction of what slides",
    )

    @property
    def sliding(self) -> float:
        """The kinetic coefficient."""
        coefficient = self.kinetic if self.mu is None else self.mu
        assert coefficient is not None
        return coefficient

    @model_validator(mode="after")
    def _mu_or_both(self) -> Self:
        both = (self.static, self.kinetic)
        if self.mu is not None:
            if both != (None, None):
                raise ValueError("must have mu alone, or static and kinetic without mu")
            return self
        if self.static is None or self.kinetic is None:
            raise ValueError("must have mu, or both static and kinetic")
        # What rests would hold less than what slides.
        if self.kinetic > self.static:
            raise ValueError(
                f"kinetic must be at most static, and {self.kinetic:g} is above {self.static:g}"
            )
        return self


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
    materials: Annotated[dict[CustomName, FabricNumbers | None], BY_NAME] = Field(
        default_factory=dict,
        max_length=MAX_MATERIALS,
        description="custom fabrics; null, in documents of samples, where a fabric is built in",
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
        """Number of frames, the first one at 0 s included."""
        # A frame at 0 s, and one after each whole period. With the tolerance, 0.29 s at 100 frames
        # a second have 30 frames, although 0.29 * 100 is less than 29 in floating point.
        longest = self.duration if self.end is None else self.end.at_most
        return int((longest or 0.0) * self.frame_rate * (1.0 + 1e-12)) + 1

    @property
    def holders(self) -> tuple[tuple[str, str], ...]:
        """Sheet and name of each holder, in the order of arrays."""
        names: list[tuple[str, str]] = []
        for sheet_name, sheet in self.sheets.items():
            names += [(sheet_name, holder) for holder in sheet.holders]
        return tuple(names)

    def pairs(self) -> Iterator[tuple[str, str]]:
        """Yield each two things that may touch.

        Sheets touch each other, themselves and bodies.
        """
        for first, second in combinations_with_replacement(self.sheets, 2):
            if first != second or self.sheets[first].self_contact:
                yield first, second
        for body in self.bodies:
            for sheet in self.sheets:
                yield sheet, body

    def mu(self, first: str, second: str) -> float:
        """Return the coefficient of friction of two things that slide on each other."""
        for pair in self.friction:
            if set(pair.between) == {first, second}:
                return pair.sliding
        # The document has been checked: a pair without a coefficient has the default one.
        assert self.default_friction is not None
        return self.default_friction

    def files(self) -> Iterator[tuple[Location, str]]:
        """Yield the location in the document and the name of each file of the physics."""
        # Holders and bodies move; a plane does not.
        motions: list[tuple[Location, Motion | None]] = []
        for name, sheet in self.sheets.items():
            if isinstance(sheet.mesh, FileMesh):
                yield ("sheets", name, "mesh", "file"), sheet.mesh.file
            if isinstance(sheet.start, FromFile) and sheet.start.file is not None:
                yield ("sheets", name, "start", "file"), sheet.start.file
            for key, holder in sheet.holders.items():
                motions.append((("sheets", name, "holders", key, "motion"), holder.motion))
        for name, body in self.bodies.items():
            if isinstance(body, MeshBody):
                yield ("bodies", name, "file"), body.file
            if not isinstance(body, Plane):
                motions.append((("bodies", name, "motion"), body.motion))
        for location, motion in motions:
            if motion and motion.path:
                yield (*location, "path"), motion.path

    @model_validator(mode="after")
    def _known_materials(self) -> Self:
        for name in self.materials:
            if name in list(Material):
                refuse(self, ("materials", name), "must not redefine what is built in", name)
        # Custom fabrics of the scene are known to its sheets alone.
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
            rule = "one of duration [s] and end must be given, and not both"
            refuse(self, ("duration",), rule, self.duration)
        # Arrays over time have a row for each frame.
        if self.frames > MAX_FRAMES:
            rule = (
                f"length [s] times frame_rate [1/s] must be at most {MAX_FRAMES} frames, and gives "
                f"{self.frames}"
            )
            refuse(self, ("frame_rate",), rule, self.frame_rate)
        for name, sheet in self.sheets.items():
            self._check_extent(name, sheet)
        # Time and memory grow with the vertices of all sheets together.
        vertices = sum(sheet.mesh.shape[0] for sheet in self.sheets.values())
        if vertices > MAX_VERTICES:
            rule = f"must have at most {MAX_VERTICES} vertices together"
            refuse(self, ("sheets",), rule, vertices)
        for name, sheet in self.sheets.items():
            self._check_sheet(name, sheet)
        return self

    def _check_extent(self, name: str, sheet: Sheet) -> None:
        # A mesh in a file is measured when the file is read.
        if isinstance(sheet.mesh, FileMesh):
            return
        extent = max(sheet.mesh.size)
        if not SMALLEST <= extent <= LARGEST:
            rule = f"the longer side must be {SMALLEST:g} to {LARGEST:g} m, and is {extent:g} m"
            location = ("sheets", name, "mesh", "size")
            refuse(self, location, rule + unit_hint(extent), list(sheet.mesh.size))

    def _check_sheet(self, name: str, sheet: Sheet) -> None:
        location = ("sheets", name)
        # Only a single sheet may pass through itself.
        if not sheet.self_contact and len(self.sheets) > 1:
            rule = "must be true if there are several sheets"
            refuse(self, (*location, "self_contact"), rule, False)
        count = sheet.mesh.shape[0]
        if count * self.frames > MAX_TRACK:
            rule = (
                f"vertices times frames must be at most {MAX_TRACK}, and there are {count} and "
                f"{self.frames}"
            )
            refuse(self, (*location, "mesh"), rule, count * self.frames)
        # The number of vertices of a file is 0 before the file is read.
        for key, holder in sheet.holders.items():
            if count and holder.vertices and max(holder.vertices) >= count:
                last = max(holder.vertices)
                position = holder.vertices.index(last)
                rule = f"must be a vertex of the sheet, below {count}"
                refuse(self, (*location, "holders", key, "vertices", position), rule, last)

    @model_validator(mode="after")
    def _hangs_under_gravity(self) -> Self:
        # A sheet without a weight has no shape of hanging.
        if any(self.gravity):
            return self
        for name, sheet in self.sheets.items():
            if isinstance(sheet.start, Hung):
                rule = "must not be hung where gravity is zero: start it flat, or give it a gravity"
                refuse(self, ("sheets", name, "start"), rule, sheet.start.type)
        return self

    @model_validator(mode="after")
    def _friction_of_each_two(self) -> Self:
        shared_names = sorted(set(self.sheets) & set(self.bodies))
        if shared_names:
            rule = "sheets and bodies must have names of their own"
            refuse(self, ("bodies", shared_names[0]), rule, shared_names[0])
        # A pair has no order, and a sheet with itself is a pair of one name.
        touching = {frozenset(pair) for pair in self.pairs()}
        listed: set[frozenset[str]] = set()
        for position, entry in enumerate(self.friction):
            pair = frozenset(entry.between)
            location = ("friction", position, "between")
            if pair not in touching:
                known = [*self.sheets, *self.bodies]
                hints = [did_you_mean(name, known) for name in entry.between if name not in known]
                rule = f"must name two that may touch{''.join(hints)}"
                refuse(self, location, rule, list(entry.between))
            if pair in listed:
                refuse(self, location, "must name two once", list(entry.between))
            listed.add(pair)
        missing = sorted(sorted(pair) for pair in touching - listed)
        if self.default_friction is None and missing:
            rule = "must name each two that may touch if there is no default_friction; missing: "
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
        """Yield the location in the document and the name of each file of the scene."""
        yield from super().files()
        for name, appearance in self.looks.sheets.items():
            if appearance.texture not in list(Texture):
                yield ("looks", "sheets", name, "texture"), appearance.texture

    @model_validator(mode="after")
    def _looks_of_known_things(self) -> Self:
        for group in ("sheets", "bodies"):
            known = getattr(self, group)
            for name in getattr(self.looks, group):
                if name not in known:
                    rule = f"must be one of {', '.join(known) or 'none'}{did_you_mean(name, known)}"
                    refuse(self, ("looks", group, name), rule, name)
        if len(self.looks.sheets) == len(self.sheets):
            rule = "must leave one sheet to the axis texture"
            refuse(self, ("looks", "sheets"), rule, list(self.looks.sheets))
        return self


class Scene(Staged):
    """A scene: its physics, its parameters and its looks."""

    @model_validator(mode="after")
    def _cards_are_there(self) -> Self:
        for name, card in self.materials.items():
            if card is None:
                refuse(self, ("materials", name), "must be the card of a fabric", None)
        return self

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
        return self._numbers_of(Staged)

    def physics(self) -> dict[str, Any]:
        """Return the part of the document, as JSON, that a trajectory depends on."""
        return self._numbers_of(Physics)

    def _numbers_of(self, part: type[Physics]) -> dict[str, Any]:
        document = self.model_dump(mode="json", include=set(part.model_fields))
        # The sources of cards are for people.
        for card in document["materials"].values():
            card.pop("source", None)
        return document

    @property
    def has_slots(self) -> bool:
        """True if documents of samples can name fabrics by their sheets: see `with_slots`.

        A parameter that sets a number of a card needs the card under its name.
        """
        sets = [self.locations(name) for name in self.parameters]
        sets_cards = any(place[0] == "materials" for places in sets for place in places)
        return bool(self.materials) and not sets_cards

    def with_slots(self, document: dict[str, Any]) -> dict[str, Any]:
        """Return a part of the document in which fabrics have no names of the user.

        Content keys then follow the numbers of the fabrics that are there, and no others.
        """
        if not self.has_slots:
            return document
        slots: dict[str, Any] = {}
        sheets: dict[str, Any] = {}
        for name, sheet in document["sheets"].items():
            material, slots[self.slot(name)] = self.slotted(name, sheet["material"])
            sheets[name] = {**sheet, "material": material}
        return {**document, "materials": slots, "sheets": sheets}

    def slot(self, sheet: str) -> str:
        """Return the name of the fabric of a sheet in documents of samples."""
        return f"of-sheet-{list(self.sheets).index(sheet)}"

    def slotted(self, sheet: str, material: str) -> tuple[str, dict[str, Any] | None]:
        """Return the name and the numbers of a fabric of a sheet; None if it is built in."""
        card = self.materials.get(material)
        return (material, None) if card is None else (self.slot(sheet), card.numbers())

    def locations(self, parameter: str) -> tuple[Location, ...]:
        """Return the locations in the document that a parameter sets."""
        document = self.physics()
        return tuple(resolve_path(document, path) for path in self.parameters[parameter].sets)

    def default(self, parameter: str) -> Value:
        """Return the value of a parameter without an axis: the default in the document."""
        value: Value = value_at(self.physics(), self.locations(parameter)[0])
        return value

    def physics_with(self, values: Mapping[Location, Any]) -> Physics:
        """Return the physics with other values at locations; raise ValidationError."""
        return Physics.model_validate(with_values(self.physics(), values))

    @model_validator(mode="after")
    def _parameters_fit(self) -> Self:
        document = self.physics()
        owners: dict[Location, str] = {}
        for name, parameter in self.parameters.items():
            parameter.check(self, name, document, owners)
            # The scene must be right with each parameter at its ends.
            for end, value in parameter.extremes:
                try:
                    self.physics_with(dict.fromkeys(self.locations(name), value))
                except ValidationError as error:
                    refuse_as(error, self, ("parameters", name, *end), value)
        return self
