"""Rigid bodies that cloth touches: planes, spheres, cylinders and boxes."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core.arrays import Floats

MU_MAX = 10.0
"""Largest coefficient of friction."""


BodyTuple = tuple[int, float, Floats, Floats, Floats]


@dataclass(frozen=True)
class Body:
    """A rigid body. In its own axes a plane fills z < 0; the others are centred on their origin, and z is the axis of a
    cylinder.

    Raises:
        ValueError: `mu` is out of range.
    """

    mu: float
    """Coefficient of friction, 0 ... 10."""

    shape: int = 0
    """0 plane, 1 sphere, 2 box, 3 cylinder: `contact::Shape` of the core."""

    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Radius of a sphere or cylinder, or half edges of a box [m]."""

    origin: Floats = field(default_factory=lambda: np.zeros(3))
    """(3,) [m]"""

    rotation: Floats = field(default_factory=lambda: np.eye(3))
    """(3, 3): columns are the axes of the body in the world."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.mu <= MU_MAX:
            raise ValueError(f"mu: must be in [0, {MU_MAX:g}], got {self.mu}")

    @property
    def pose(self) -> Floats:
        """(3, 4): from its own axes to the world, x -> A x + b [m]."""
        return np.column_stack([self.rotation, self.origin])

    def as_tuple(self) -> BodyTuple:
        """Return the arguments of the C++ core."""
        return (
            self.shape,
            self.mu,
            np.array(self.size),
            np.asarray(self.origin, float),
            np.asarray(self.rotation, float),
        )


def plane(mu: float, *, normal: ArrayLike = (0.0, 0.0, 1.0), origin: ArrayLike = (0.0, 0.0, 0.0)) -> Body:
    """Return the half-space below a plane."""
    n = np.asarray(normal, float)
    n = n / np.linalg.norm(n)
    other = np.eye(3)[np.argmin(np.abs(n))]
    t = np.cross(n, other)
    t /= np.linalg.norm(t)
    return Body(mu, 0, origin=np.asarray(origin, float), rotation=np.stack([t, np.cross(n, t), n], axis=1))


def sphere(mu: float, radius: float, *, origin: ArrayLike = (0.0, 0.0, 0.0), rotation: ArrayLike | None = None) -> Body:
    """Return a ball. Cloth that sticks to it turns with it as its rotation (3, 3) changes from step to step."""
    return _placed(mu, 1, _radius(radius), origin, rotation)


def cylinder(
    mu: float, radius: float, *, origin: ArrayLike = (0.0, 0.0, 0.0), rotation: ArrayLike | None = None
) -> Body:
    """Return a cylinder without ends, whose axis is the last column of its rotation (3, 3)."""
    return _placed(mu, 3, _radius(radius), origin, rotation)


def box(mu: float, size: ArrayLike, *, origin: ArrayLike = (0.0, 0.0, 0.0), rotation: ArrayLike | None = None) -> Body:
    """Return a box with edges of `size` (3,) [m]."""
    half = 0.5 * np.asarray(size, float)
    if half.shape != (3,) or not (np.isfinite(half).all() and (half > 0.0).all()):
        raise ValueError(f"size: must be three finite lengths > 0, got {size!r}")
    return _placed(mu, 2, (half[0], half[1], half[2]), origin, rotation)


def _radius(radius: float) -> tuple[float, float, float]:
    if not (np.isfinite(radius) and radius > 0.0):
        raise ValueError(f"radius: must be finite and > 0, got {radius}")
    return radius, 0.0, 0.0


def _placed(
    mu: float, shape: int, size: tuple[float, float, float], origin: ArrayLike, rotation: ArrayLike | None
) -> Body:
    turn = np.eye(3) if rotation is None else np.asarray(rotation, float)
    return Body(mu, shape, size, np.asarray(origin, float), turn)
