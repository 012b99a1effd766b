"""Axes of a parameter grid: a list, a linspace, or a seeded random or Sobol sample of a range.

The short forms are `0.5` for one value and `[0.1, 0.2]` for a list.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Generic, Literal, Self, TypeVar

from pydantic import BeforeValidator, FailFast, Field, GetJsonSchemaHandler, Strict, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError

from stickslip_schemas.base import WHOLE, Document

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

MAX_SAMPLES = 1_000_000
"""The most samples that one job may ask for."""

T = TypeVar("T")
Count = Annotated[int, Strict(), Field(ge=1, le=MAX_SAMPLES), WHOLE]
Seed = Annotated[
    int, Strict(), Field(ge=0, lt=2**31, description="seed of all random draws"), WHOLE
]


@dataclass(frozen=True)
class quantity:  # noqa: N801 - reads as an annotation
    """Name a value's type in the JSON schema: `Annotated[float, quantity("Mu"), ...]`."""

    name: str


def _quantity_name(parameter: Any) -> str:
    for item in getattr(parameter, "__metadata__", ()):
        if isinstance(item, quantity):
            return item.name
    return str(getattr(parameter, "__name__", ""))


class _Axis(Document, Generic[T]):
    @classmethod
    def model_parametrized_name(cls, params: tuple[Any, ...]) -> str:
        """Name `ListAxis[Mu]` in the JSON schema `ListAxisMu`: see `quantity`."""
        return cls.__name__ + "".join(_quantity_name(item) for item in params)


class ListAxis(_Axis[T], Generic[T]):
    """The values themselves; only axes that are zipped may have one twice."""

    type: Literal["list"]
    # After the first wrong value the others are not checked: a megabyte has 300,000 of them, and
    # each error takes a kilobyte.
    values: Annotated[tuple[T, ...], FailFast()] = Field(min_length=1, max_length=MAX_SAMPLES)

    @property
    def num(self) -> int:
        return len(self.values)


class LinspaceAxis(_Axis[T], Generic[T]):
    """`num` values from `start` to `stop`, both included."""

    type: Literal["linspace"]
    start: T
    stop: T
    num: Count

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        if self.num > 1 and self.start == self.stop:
            raise ValueError("start and stop must differ when num is more than 1")
        return self


class _RangeAxis(_Axis[T], Generic[T]):
    low: T
    high: T
    num: Count
    seed: Seed = 0

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low < self.high:  # type: ignore[operator]  # T is a float wherever this axis is used
            raise ValueError(
                f"low must be less than high, and {self.low} is not less than {self.high}"
            )
        return self


class RandomAxis(_RangeAxis[T], Generic[T]):
    """`num` independent uniform values in [low, high)."""

    type: Literal["random"]


class SobolAxis(_RangeAxis[T], Generic[T]):
    """`num` values of a scrambled Sobol sequence in [low, high)."""

    type: Literal["sobol"]


def long_form(value: Any) -> Any:
    """Return an axis in its long form: a value and a list become a list with its type."""
    # The short forms: a list, and one value.
    if isinstance(value, list | tuple):
        return {"type": "list", "values": value}
    # In Python, True is an int.
    if value is None or isinstance(value, bool):
        raise PydanticCustomError(
            "axis_form",
            "must be a value, a list of values, or an object with the field type",
        )
    if isinstance(value, int | float | str):
        return {"type": "list", "values": [value]}
    return value


class Shorthand(BeforeValidator):
    """Accepts the short form of an axis, in validation and in the JSON schema."""

    def __get_pydantic_json_schema__(
        self, core: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        # The short forms take a value of the list, which the schema has already.
        long = handler(core)
        if handler.mode == "serialization":
            return long
        reference = (
            {"$ref": long["discriminator"]["mapping"]["list"]} if "discriminator" in long else long
        )
        values = handler.resolve_ref_schema(reference)["properties"]["values"]
        short = {name: value for name, value in values.items() if name != "title"}
        return {"anyOf": [values["items"], short, long]}


SHORTHAND = Shorthand(long_form)
"""Lets an axis be written in its short form."""
TAGGED = Field(discriminator="type")
"""Stands before `SHORTHAND` if an axis has several forms."""

AnyAxis = ListAxis[Any] | LinspaceAxis[Any] | RandomAxis[Any] | SobolAxis[Any]


def axis_values(axis: AnyAxis, *, dimension: int = 0) -> list[Any]:
    """Return the values of `axis` in order.

    `dimension` keeps axes apart that are sampled together: it selects the dimension of the Sobol
    sequence and the stream of the random generator.
    """
    match axis:
        case ListAxis():
            return list(axis.values)
        case LinspaceAxis(start=start, stop=stop, num=num):
            step = (stop - start) / max(1, num - 1)  # these are the bits of numpy.linspace
            return [float(position * step + start) for position in range(num - 1)] + [
                float(stop if num > 1 else start)
            ]
        case _:
            drawn: list[Any] = drawn_values(axis, dimension=dimension).tolist()
            return drawn


def extremes(axis: AnyAxis) -> list[tuple[tuple[str | int, ...], Any]]:
    """Return values that stand for all others in rules of ranges, each with its position."""
    if isinstance(axis, ListAxis):
        return [(("values", position), value) for position, value in enumerate(axis.values)]
    ends = ("start", "stop") if isinstance(axis, LinspaceAxis) else ("low", "high")
    return [((end,), getattr(axis, end)) for end in ends]


def drawn_values(
    axis: RandomAxis[Any] | SobolAxis[Any], *, dimension: int = 0
) -> "npt.NDArray[np.float64]":
    """Return the values of an axis that is drawn; see `axis_values`."""
    import numpy as np  # the extra `arrays`

    if isinstance(axis, SobolAxis):
        unit = _sobol(axis.num, axis.seed, dimension)
    else:
        unit = np.random.Generator(np.random.PCG64([axis.seed, dimension])).random(axis.num)
    values: npt.NDArray[np.float64] = axis.low + (axis.high - axis.low) * unit
    return values


def _sobol(num: int, seed: int, dimension: int) -> "npt.NDArray[np.float64]":
    import numpy as np
    from scipy.stats import qmc  # an extra: only who expands a spec needs it

    # A Sobol sequence is even only over a power of two: draw the next one and cut it.
    exponent = max(0, int(num - 1).bit_length())
    generator = np.random.Generator(np.random.PCG64(seed))
    points = qmc.Sobol(dimension + 1, scramble=True, rng=generator).random_base2(exponent)
    return np.asarray(points[:num, dimension])
