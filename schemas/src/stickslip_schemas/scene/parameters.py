"""Parameters of a scene, and the paths into the document that they set."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Never

from pydantic import BaseModel, Field, StringConstraints, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from stickslip_schemas.base import Document, Float, location_as_written, replace_at, unit_in
from stickslip_schemas.spec.explanations import explain
from stickslip_schemas.spec.names import CustomName, did_you_mean

Location = tuple[str | int, ...]
"""A location in a document: names, and positions in lists."""

ParameterName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,62}$")]

Value = Float | CustomName
"""The value of a parameter: a number, or the name of a fabric."""

LOOKS_AXES = ("texture", "viewpoint", "lighting", "substrate")
"""Axes that every scene has: no parameter may have their names."""

_COEFFICIENTS = ("static", "kinetic")
"""Of a pair that has both instead of `mu`."""

_FIXED = ("duration", "end", "frame_rate", "spacing")
"""Numbers that decide on the shapes of arrays."""


class Parameter(Document):
    """A value that may vary, which is set at one or several locations of the document.

    The document itself has the default at these locations.
    """

    unit: Annotated[str, StringConstraints(max_length=32)] = Field(
        default="1", description="of the numbers"
    )
    low: Float | None = Field(default=None, description="least number that it may be")
    high: Float | None = Field(default=None, description="largest number that it may be")
    values: tuple[Value, ...] | None = Field(
        default=None, min_length=1, description="all that it may be"
    )
    sets: tuple[Annotated[str, Field(min_length=1, max_length=300)], ...] = Field(
        min_length=1, max_length=64
    )
    description: str = Field(default="", max_length=300, description="for people")

    def check(
        self, scene: Any, name: str, document: Mapping[str, Any], owners: dict[Location, str]
    ) -> None:
        """Check a parameter of a scene, whose `document` is JSON.

        `owners` has the locations of parameters before it, and gets the locations of this one.
        """
        parent: Location = ("parameters", name)
        if name in LOOKS_AXES:
            rule = f"must not have the name of an axis of all scenes: {', '.join(LOOKS_AXES)}"
            refuse(scene, parent, rule, name)
        defaults = []
        for number, path in enumerate(self.sets):
            path_location = (*parent, "sets", number)
            try:
                location = resolve_path(document, path)
            except LookupError as error:
                refuse(scene, path_location, str(error.args[0]), path)
            self._check_target(scene, parent, path, location, document)
            # Two parameters at one location would contradict each other.
            if location in owners:
                rule = f"must not lead where {owners[location]!r} does"
                refuse(scene, path_location, rule, path)
            owners[location] = name
            defaults.append(value_at(document, location))
        if len(set(defaults)) > 1:
            rule = "must find one value, the default, at all paths; they have "
            rule += ", ".join(map(str, defaults))
            refuse(scene, (*parent, "sets"), rule, list(self.sets))
        self._check_range(scene, parent, defaults[0])

    def _check_target(
        self, scene: Any, parent: Location, path: str, location: Location, document: Any
    ) -> None:
        """Check that a parameter may set the value at a location, and has its unit."""
        value = value_at(document, location)
        is_number = isinstance(value, float) and not set(location) & {*_FIXED}
        # Sizes of a grid leave its vertices alone; those of other meshes change their number.
        decides_on_shapes = (
            location[0] == "sheets"
            and location[2] == "mesh"
            and document["sheets"][location[1]]["mesh"]["type"] != "grid"
        )
        number = self.sets.index(path)
        if not ((is_number and not decides_on_shapes) or location[-1] == "material"):
            rule = (
                "must lead to a number or a material, and not to a value that decides on shapes of "
                "arrays or on files"
            )
            refuse(scene, (*parent, "sets", number), rule, path)
        unit = unit_in(scene, location) if is_number else self.unit
        if self.unit != unit:
            refuse(scene, (*parent, "unit"), f"must be {unit}, as of {path}", self.unit)

    def _check_range(self, scene: Any, parent: Location, default: Value) -> None:
        if isinstance(default, str) or self.values is not None:
            for end, bound in (("low", self.low), ("high", self.high)):
                if bound is not None:
                    rule = "is for numbers without a list of values"
                    refuse(scene, (*parent, end), rule, bound)
            for number, value in enumerate(self.values or ()):
                if type(value) is not type(default):
                    kind = "name" if isinstance(default, str) else "number"
                    rule = f"must be a {kind}, as in the document"
                    refuse(scene, (*parent, "values", number), rule, value)
        elif self.low is None or self.high is None or not self.low < self.high:
            rule = f"low and high [{self.unit}] must be given, low below high"
            refuse(scene, (*parent, "low"), rule, self.low)
        # The document itself must be a point of the grid.
        if not self.allows(default):
            rule = f"must lead to a default within {self.range}"
            refuse(scene, (*parent, "sets", 0), rule, default)

    @property
    def extremes(self) -> list[tuple[Location, Value]]:
        """Values that stand for all others, each with its position in the parameter.

        Rules of numbers are ranges, so the ends of a range stand for it.
        """
        # A parameter has a list of values, or two ends.
        listed: list[tuple[Location, Value | None]] = [
            (("values", at), value) for at, value in enumerate(self.values or ())
        ]
        locations = [*listed, (("low",), self.low), (("high",), self.high)]
        return [(location, value) for location, value in locations if value is not None]

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and largest number that it may be; not for names."""
        numbers = [value for _, value in self.extremes if isinstance(value, float)]
        return min(numbers), max(numbers)

    @property
    def range(self) -> str:
        """The allowed values, in words."""
        # A pure number has no unit to show.
        unit = "" if self.unit == "1" else f" [{self.unit}]"
        if self.values is not None:
            return ", ".join(map(str, self.values)) + unit
        return "all fabrics" if self.low is None else f"{self.low:g} to {self.high:g}{unit}"

    def allows(self, value: Value) -> bool:
        if self.values is not None:
            return value in self.values
        if self.low is None or self.high is None:
            return isinstance(value, str)
        return isinstance(value, float | int) and self.low <= value <= self.high


def resolve_path(document: Mapping[str, Any], path: str) -> Location:
    """Return the location that a dotted path leads to.

    `friction.A.B` finds the coefficient of two in any order, `friction.A.B.static` and `.kinetic`
    those of two that have both.

    Raises LookupError, which names the last location that exists.
    """
    words = path.split(".")
    is_of_pair = len(words) == 3 or (len(words) == 4 and words[3] in _COEFFICIENTS)
    if words[0] == "friction" and is_of_pair:
        return _resolve_friction(document["friction"], *words[1:])
    value: Any = document
    location: list[str | int] = []
    for word in words:
        # A word is a name in a mapping and a position in a list. Nothing else has parts.
        step: str | int = word
        known: Sequence[str | int] = ()
        if isinstance(value, dict):
            known = list(value)
        elif isinstance(value, list):
            known = range(len(value))
            step = int(word) if word.isdecimal() else word
        if step not in known:
            raise LookupError(_dead_end(location, word, [str(name) for name in known]))
        value = value[step]
        location.append(step)
    return tuple(location)


def _resolve_friction(
    pairs: Sequence[Mapping[str, Any]], first: str, second: str, coefficient: str = "mu"
) -> Location:
    """Return the location of a coefficient of friction of two things; raise LookupError."""
    for number, pair in enumerate(pairs):
        if sorted(pair["between"]) != sorted((first, second)):
            continue
        if coefficient in pair:
            return ("friction", number, coefficient)
        known = [f"friction.{first}.{second}.{name}" for name in _COEFFICIENTS if name in pair]
        raise LookupError(
            "must lead to a coefficient of the pair, which has "
            + (" and ".join(known) or f"one, friction.{first}.{second}")
        )
    raise LookupError(f"must name two of `friction`, which has no pair of {first} and {second}")


def _dead_end(location: Sequence[str | int], word: str, names: list[str]) -> str:
    """Return the message for a path that leads nowhere from a location on."""
    parent = ".".join(map(str, location)) or "the document"
    hint = did_you_mean(word, names)
    message = f"must be a path into the document: {parent} has no {word!r}{hint}"
    if names:
        message += f"; it has {', '.join(names[:32])}"
    return message


def value_at(document: Any, location: Location) -> Any:
    """Return the value at a location of a document."""
    for step in location:
        document = document[step]
    return document


def with_values(document: Any, values: Mapping[Location, Any]) -> Any:
    """Return a copy of a document with other values at some locations."""
    for location, value in values.items():
        document = replace_at(document, location, value)
    return document


def refuse(model: BaseModel, location: Location, rule: str, value: Any) -> Never:
    """Raise a ValidationError for one value of a document.

    It names the position, the rule that does not hold, and the value.
    """
    broken = PydanticCustomError("broken_rule", "{rule}", {"rule": rule})
    raise ValidationError.from_exception_data(
        type(model).__name__, [InitErrorDetails(type=broken, loc=location, input=value)]
    )


def refuse_as(error: ValidationError, scene: Any, location: Location, value: Any) -> Never:
    """Raise a ValidationError for a value that breaks a rule of the scene that it is put into.

    The value stands at `location` of the spec; the message names the path in the scene.
    """
    first = error.errors(include_url=False)[0]
    explanation = explain(first, type(scene))
    written = location_as_written(explanation.location, scene.physics(), keep_last=True)
    refuse(scene, location, f"sets {'.'.join(map(str, written))}: {explanation.rule}", value)
