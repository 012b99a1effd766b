"""Parameters of a scene, and the paths into the document that they set."""

from collections.abc import Mapping
from typing import Annotated, Any, Never

from pydantic import BaseModel, Field, StringConstraints, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from stickslip_schemas.base import Document, Float, replace_at, unit_in, unit_of
from stickslip_schemas.spec.names import CustomName, did_you_mean

Location = tuple[str | int, ...]
"""A location in a document: names, and positions in lists."""

ParameterName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,62}$")]

Value = Float | CustomName
"""What a parameter may be: a number, or the name of a fabric."""

LOOKS_AXES = ("texture", "viewpoint", "lighting", "substrate")
"""Axes that every scene has: no parameter may have their names."""

_FIXED = ("duration", "end", "frame_rate", "spacing")
"""Numbers that decide on the shapes of arrays."""


class Parameter(Document):
    """What may vary: one value, which is set at one or several locations of the document.

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
        self, scene: Any, name: str, document: Mapping[str, Any], taken: dict[Location, str]
    ) -> None:
        """Check a parameter of a scene, whose `document` is JSON.

        `taken` has the locations of parameters before it.
        """
        here: Location = ("parameters", name)
        if name in LOOKS_AXES:
            refuse(
                scene,
                here,
                f"must not have the name of an axis of all scenes: {', '.join(LOOKS_AXES)}",
                name,
            )
        defaults = []
        for number, path in enumerate(self.sets):
            path_location = (*here, "sets", number)
            try:
                location = resolve_path(document, path)
            except LookupError as error:
                refuse(scene, path_location, str(error.args[0]), path)
            value = value_at(document, location)
            is_number = isinstance(value, float) and not set(location) & {*_FIXED}
            sized = (
                location[0] == "sheets"
                and location[2] == "mesh"
                and document["sheets"][location[1]]["mesh"]["type"] != "grid"
            )
            if not ((is_number and not sized) or location[-1] == "material"):
                rule = (
                    "must lead to a number or a material, and not to what decides on shapes of "
                    "arrays or on files"
                )
                refuse(scene, path_location, rule, path)
            if is_number and self.unit != (unit := unit_in(scene, location)):
                refuse(scene, (*here, "unit"), f"must be {unit}, as of {path}", self.unit)
            if location in taken:
                refuse(scene, path_location, f"must not lead where {taken[location]!r} does", path)
            taken[location] = name
            defaults.append(value)
        if len(set(defaults)) > 1:
            rule = "must find one value, the default, at all locations"
            refuse(
                scene,
                (*here, "sets"),
                f"{rule}; they have {', '.join(map(str, defaults))}",
                list(self.sets),
            )
        self._check_range(scene, here, defaults[0])

    def _check_range(self, scene: Any, here: Location, default: Value) -> None:
        if isinstance(default, str) or self.values is not None:
            for end in ("low", "high"):
                if getattr(self, end) is not None:
                    refuse(
                        scene,
                        (*here, end),
                        "is for numbers without a list of values",
                        getattr(self, end),
                    )
            for number, value in enumerate(self.values or ()):
                if type(value) is not type(default):
                    kind = "name" if isinstance(default, str) else "number"
                    refuse(
                        scene,
                        (*here, "values", number),
                        f"must be a {kind}, as in the document",
                        value,
                    )
        elif self.low is None or self.high is None or not self.low < self.high:
            refuse(
                scene,
                (*here, "low"),
                f"low and high [{self.unit}] must be given, low below high",
                self.low,
            )
        if not self.allows(default):
            refuse(
                scene, (*here, "sets", 0), f"must lead to a default within {self.range}", default
            )

    @property
    def extremes(self) -> list[tuple[Location, Value]]:
        """Values that stand for all others, each with its position in the parameter.

        Rules of numbers are ranges, so the ends of a range stand for it.
        """
        listed: list[tuple[Location, Value | None]] = [
            (("values", at), value) for at, value in enumerate(self.values or ())
        ]
        locations = [*listed, (("low",), self.low), (("high",), self.high)]
        return [(location, value) for location, value in locations if value is not None]

    @property
    def range(self) -> str:
        """What it may be, in words."""
        if self.values is not None:
            return f"{', '.join(map(str, self.values))} [{self.unit}]"
        return "all fabrics" if self.low is None else f"{self.low:g} to {self.high:g} [{self.unit}]"

    def allows(self, value: Value) -> bool:
        if self.values is not None:
            return value in self.values
        if self.low is None or self.high is None:
            return isinstance(value, str)
        return isinstance(value, float | int) and self.low <= value <= self.high


def resolve_path(document: Mapping[str, Any], path: str) -> Location:
    """Return the location that a dotted path leads to.

    `friction.A.B` finds the coefficient of two in any order.

    Raises LookupError, which says from where on it leads nowhere.
    """
    words = path.split(".")
    if words[0] == "friction" and len(words) == 3:
        for number, pair in enumerate(document["friction"]):
            if sorted(pair["between"]) == sorted(words[1:]):
                return ("friction", number, "mu")
        raise LookupError(
            f"must name two of `friction`, which has no pair of {words[1]} and {words[2]}"
        )
    here: Any = document
    location: list[str | int] = []
    for word in words:
        step: str | int = int(word) if isinstance(here, list) and word.isdecimal() else word
        known = (
            range(len(here))
            if isinstance(here, list)
            else list(here)
            if isinstance(here, dict)
            else []
        )
        if step not in known:
            names = [str(name) for name in known]
            where = ".".join(map(str, location)) or "the document"
            raise LookupError(
                f"must be a path into the document: {where} has no "
                f"{word!r}{did_you_mean(word, names)}"
                + (f"; it has {', '.join(names[:32])}" if names else "")
            )
        here = here[step]
        location.append(step)
    return tuple(location)


def value_at(document: Any, location: Location) -> Any:
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


def refuse_as(error: ValidationError, scene: BaseModel, location: Location, value: Any) -> Never:
    """Raise a ValidationError for a value that another part of a document, a scene, makes wrong."""
    first = error.errors(include_url=False)[0]
    rule = first["msg"].removeprefix("Value error, ") + unit_of(first, type(scene))
    path = ".".join(_path_in(scene.model_dump(mode="json"), first["loc"]))
    refuse(scene, location, f"sets {path}: {rule}", value)


def _path_in(document: Any, location: Location) -> list[str]:
    """Return the steps of a location that lead into a document.

    pydantic adds the tags of unions, which nobody has written.
    """
    steps = []
    for step in location:
        try:
            document = document[step]
        except (KeyError, IndexError, TypeError):
            continue  # a tag is no key of an object and no position in a list
        steps.append(str(step))
    return steps
