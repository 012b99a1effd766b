"""Derivatives of runs of cloth: which parameters a spec may ask for, and the arrays of them."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Protocol

from pydantic import Field

from stickslip_schemas.base import Document, Float, Int
from stickslip_schemas.scene.parameters import Location
from stickslip_schemas.scene.parts import MeshBody
from stickslip_schemas.spec.arrays import DERIVATIVE_BY, ArrayLayout, array

if TYPE_CHECKING:
    from stickslip_schemas.scene.document import Scene


class DifferentiatedSpec(Protocol):
    """What this module asks of a spec."""

    @property
    def sensitivities(self) -> tuple[str, ...]:
        """Parameters that its runs are differentiated by."""
        ...

    @property
    def instants(self) -> int: ...

    @property
    def instants_per_second(self) -> float: ...

    def parameter_unit(self, name: str) -> str: ...


MOST = 8
"""Parameters that a run is differentiated by at most: each has as many numbers as the positions."""

COST = 0.5
"""Cost of a derivative over that of the run without: 0.4 at mesh 21, 0.48 at mesh 41."""


def names_field() -> Any:
    """Return the field of the parameters that the runs of a spec are differentiated by.

    Documents leave it out if it is empty, so that specs without keep their content keys.
    """
    return Field(
        default=(),
        max_length=MOST,
        exclude_if=lambda names: not names,
        description=(
            "parameters by which positions are differentiated: `mu` adds `positions_by_mu`, exact "
            "for the branch of contacts that the run took"
        ),
        json_schema_extra={
            "uniqueItems": True,
            "x-cost": "half the CPU time of the simulation, and the size of the positions, each",
        },
    )


class Differentiated(Document):
    """A parameter that a run of a scene is differentiated by."""

    places: tuple[tuple[str | Int, ...], ...] = Field(description="in the document of the scene")
    low: Float = Field(description="least value")
    high: Float = Field(description="largest value")
    unit: str


def differentiated(scene: "Scene", parameter: str) -> Differentiated:
    """Return the document of a parameter of a scene."""
    low, high = scene.parameters[parameter].bounds
    return Differentiated(
        places=scene.locations(parameter),
        low=low,
        high=high,
        unit=scene.parameters[parameter].unit,
    )


def with_derivatives(group: str, spec: DifferentiatedSpec) -> str:
    """Return a group of samples of equal cost, told apart by its number of derivatives."""
    count = len(spec.sensitivities)
    return f"{group}, {count} derivatives" if count else group


def why_not_differentiable(scene: "Scene", parameter: str) -> str:
    """Return why no run of a scene can be differentiated by a parameter, or an empty text."""
    if not isinstance(scene.default(parameter), float):
        return "is a name"
    for location in scene.locations(parameter):
        if not _is_differentiable(scene, location):
            path = ".".join(map(str, location))
            return f"sets {path}, which decides on more than forces, motions and starts"
    return ""


def _is_differentiable(scene: "Scene", location: Location) -> bool:
    """Return whether runs depend smoothly on the number at a location, as far as contacts do."""
    match location:
        case (
            ("friction", _, "mu" | "kinetic" | "static")
            | ("default_friction",)
            | ("gravity", _)
            | ("bias", "size")
        ):
            return True
        case ("materials", _, "density"):
            return True
        case ("sheets", _, "factors" | "origin" | "turn", _):
            return True
        case ("sheets", _, "start", "strain", _):
            return True
        case ("sheets", _, "holders", _, "motion", *_):
            return True
        case ("bodies", name, "origin" | "turn" | "normal" | "motion", *_):
            return not isinstance(scene.bodies[str(name)], MeshBody)
    return False


def derivative_arrays(
    spec: DifferentiatedSpec, positions: Mapping[str, ArrayLayout]
) -> Iterator[ArrayLayout]:
    """Yield the arrays of the derivatives that a spec asks for.

    `positions` are the arrays of positions, by the prefix of their names: `SHEET.` or nothing.
    """
    if not spec.sensitivities:
        return
    time = {"instants_per_second": spec.instants_per_second}
    over_instants = {"instant": spec.instants}
    for name in spec.sensitivities:
        unit = spec.parameter_unit(name)
        for prefix, layout in positions.items():
            yield array(
                f"{prefix}positions_by_{name}",
                f"derivative of the positions by {name} [m per {unit}]; NaN once it is not solved",
                "float32",
                dict(zip(layout.dimensions, layout.shape, strict=True)),
                per_sample=True,
                is_recorded=True,
                attributes={**time, DERIVATIVE_BY: name, "unit": f"m per {unit}"},
            )
        yield array(
            f"nearest_event_by_{name}",
            f"estimate of how far {name} may change until a contact changes its branch, since the "
            f"instant before [{unit}]; infinite where nothing touches",
            "float32",
            over_instants,
            is_recorded=True,
            attributes=time,
        )
        yield array(
            f"one_sided_by_{name}",
            f"1 where that is less than 0.01 % of {name}: the derivative is that of one side",
            "uint8",
            over_instants,
            is_recorded=True,
            attributes=time,
        )
        yield array(
            f"largest_by_{name}",
            f"largest derivative of a coordinate by {name} [m per {unit}]; 0 if it has no effect",
        )
    yield array("unrefined_steps", "steps whose derivatives are not solved to 1e-5", "int32")
    yield array("refinement_change", "largest change left to one more round of solving, relative")
