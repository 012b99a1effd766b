"""Parameters that a run of cloth can be differentiated by.

`Cloth.follow` takes them. The derivatives are exact for the discrete run: they are those of the
positions that the solver computes, with the lengths of its steps and the branches of its contacts
held. `Cloth.nearest_events` says how far a parameter may change until a branch changes.

`cloth/sensitivities.hpp` has the equations.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

from stickslip_sim_core.arrays import Floats

FabricProperty: TypeAlias = Literal[
    "bending",
    "stretching",
    "density",
    "bending_warp",
    "bending_weft",
    "bending_twist",
    "softening",
]
FrictionKind: TypeAlias = Literal[
    "friction_of_body", "friction_of_pair", "static_friction_of_body", "static_friction_of_pair"
]
Kind: TypeAlias = FrictionKind | FabricProperty

# The numbers of SensitivityTerm::Kind.
_NUMBERS: dict[Kind, int] = {
    "friction_of_body": 0,
    "friction_of_pair": 1,
    "bending": 2,
    "stretching": 3,
    "density": 4,
    "static_friction_of_body": 5,
    "static_friction_of_pair": 6,
    "bending_warp": 7,
    "bending_weft": 8,
    "bending_twist": 9,
    "softening": 10,
}

TermTuple: TypeAlias = tuple[int, int, int, float]
RatesTuple: TypeAlias = tuple[Floats, Floats, list[tuple[Floats, Floats]]]
"""Derivatives of held vertices, of gravity, and of the origin and turn of each body."""


def _no_points() -> Floats:
    return np.empty((0, 3))


@dataclass(frozen=True)
class DriveRates:
    """Derivatives of the driving motions and forces at one time by a parameter.

    Empty arrays are zero.

    Attributes:
        held: Of the positions of held vertices (K, 3) [m per unit of the parameter].
        gravity: Of gravity at the vertices (V, 3) [m/s^2 per unit].
        bodies: Of each body, that of its origin (3,) [m per unit], and its turn about the origin
            (3,) [rad per unit], a vector along the axis.
    """

    held: Floats = field(default_factory=_no_points)
    gravity: Floats = field(default_factory=_no_points)
    bodies: Sequence[tuple[Floats, Floats]] = ()

    def check(self, held: int, vertices: int, bodies: int) -> None:
        """Check that each array is empty or has a row for each thing.

        Raises:
            ValueError: An array has another length.
        """
        sizes = (("held", self.held, held), ("gravity", self.gravity, vertices))
        for name, points, count in sizes:
            if np.shape(points) not in ((0, 3), (count, 3)):
                raise ValueError(
                    f"rates: {name} must be empty or ({count}, 3), got {np.shape(points)}"
                )
        if len(self.bodies) not in (0, bodies):
            raise ValueError(f"rates: bodies must be none or all {bodies}, got {len(self.bodies)}")

    def as_tuple(self) -> RatesTuple:
        return self.held, self.gravity, list(self.bodies)


@dataclass(frozen=True)
class Term:
    """A number of the cloth that a parameter changes."""

    kind: Kind
    first: int = -1
    second: int = -1
    rate: float = 1.0
    """Change of the number per unit of the parameter."""

    def as_tuple(self) -> TermTuple:
        return _NUMBERS[self.kind], self.first, self.second, self.rate


@dataclass(frozen=True)
class Parameter:
    """A parameter of a run: numbers of the cloth that it changes, and parts that it moves.

    The constructors below make a parameter of one thing: `friction`, `pair_friction`,
    `fabric_factor` and `drive`.
    """

    terms: tuple[Term, ...] = ()
    rates: Callable[[float], DriveRates] | None = None

    def as_tuples(self) -> list[TermTuple]:
        return [term.as_tuple() for term in self.terms]

    def rates_at(self, time: float) -> DriveRates:
        """Return the derivatives of the drive by the parameter at a time [s]."""
        return self.rates(time) if self.rates else DriveRates()

    def check_bodies(self, bodies: int) -> None:
        """Check that a run with this number of bodies has those of the parameter.

        Raises:
            ValueError: A body does not exist.
        """
        for term in self.terms:
            of_body = term.kind in ("friction_of_body", "static_friction_of_body")
            if of_body and not 0 <= term.first < bodies:
                raise ValueError(
                    f"parameter: friction must be of one of {bodies} bodies, got {term.first}"
                )


def friction(body: int, sheet: int | None = None, *, static: bool = False) -> Parameter:
    """Return the coefficient of friction of a body, with one sheet or with all.

    It is the kinetic coefficient. With `static` it is the static one of a body that has both: only
    what holds depends on it, so positions do not change by it to first order, and
    `Cloth.nearest_events` says which change sets something off.
    """
    kind: Kind = "static_friction_of_body" if static else "friction_of_body"
    return Parameter((Term(kind, body, -1 if sheet is None else sheet),))


def pair_friction(first: int, second: int, *, static: bool = False) -> Parameter:
    """Return the coefficient of friction of two sheets, of a sheet with itself or with a surface.

    Surfaces are counted after the sheets. For `static`, see `friction`.
    """
    kind: Kind = "static_friction_of_pair" if static else "friction_of_pair"
    return Parameter((Term(kind, min(first, second), max(first, second)),))


def fabric_factor(kind: FabricProperty, sheet: int | None = None) -> Parameter:
    """Return the logarithm of a factor of a property of the fabric of one sheet, or of all.

    The derivative by the property D itself is the derivative by the logarithm over D.
    """
    return Parameter((Term(kind, -1 if sheet is None else sheet),))


def drive(rates: Callable[[float], DriveRates]) -> Parameter:
    """Return a parameter that moves held vertices, bodies or gravity.

    Args:
        rates: Function of the time [s] that returns the derivatives of the drive.
    """
    return Parameter(rates=rates)
