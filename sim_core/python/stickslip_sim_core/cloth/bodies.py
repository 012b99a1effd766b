"""Rigid bodies that cloth touches: planes, spheres, cylinders, capsules and boxes with rounded edges."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core.arrays import Floats, check_positive

ORTHONORMAL = 1e-6
"""Largest deviation of the scalar products of a rotation's axes from 0 and 1."""

MU_MAX = 10.0
"""Largest coefficient of friction."""


ROUNDING = 5e-3
"""Default radius of the edges of a box [m]; of a box thinner than two of these, half its shortest edge. Cells of up to
twice the radius slide over such an edge."""

ORIGIN = (0.0, 0.0, 0.0)
UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

BodyTuple = tuple[int, list[float], Floats, float, Floats, Floats]


@dataclass(frozen=True)
class Body:
    """A rigid body: a half-space, or all points within a radius of a core.

    The core is a box about the origin: a point of a sphere, a segment of a capsule, an endless line of a cylinder.

    Raises:
        ValueError: `mu` is out of range, `origin` is not finite, or `rotation` is no rotation.
    """

    mu: ArrayLike
    """Coefficient of friction with the cloth, 0 ... 10, or with each of its sheets: (S,)."""

    shape: int = 0
    """0 plane, which fills z < 0 in its own axes; 1 rounded: `Body::Shape` of the core."""

    core: tuple[float, float, float] = ORIGIN
    """Half edges of the core along the body's own axes [m], 0 or more; inf along the axis of an endless cylinder."""

    radius: float = 0.0
    """Distance of the body's face from its core [m]."""

    origin: ArrayLike = ORIGIN
    """(3,) [m]"""

    rotation: ArrayLike = UPRIGHT
    """(3, 3): columns are the axes of the body in the world."""

    def __post_init__(self) -> None:
        check_friction(self.mu)
        origin, turn = np.asarray(self.origin, float), np.asarray(self.rotation, float)
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise ValueError(f"origin: must be three finite numbers [m], got {origin.tolist()}")
        if (
            turn.shape != (3, 3)
            or not np.abs(turn @ turn.T - np.eye(3)).max() <= ORTHONORMAL
            or np.linalg.det(turn) < 0
        ):
            raise ValueError(f"rotation: must be orthonormal (3, 3) with determinant +1, got {turn.tolist()}")

    @property
    def pose(self) -> Floats:
        """(3, 4): from its own axes to the world, x -> A x + b [m]."""
        return np.column_stack([self.rotation, self.origin])

    def as_tuple(self) -> BodyTuple:
        """Return the arguments of the C++ core."""
        return (
            self.shape,
            np.atleast_1d(np.asarray(self.mu, float)).tolist(),
            np.array(self.core),
            self.radius,
            np.asarray(self.origin, float),
            np.asarray(self.rotation, float),
        )


def check_friction(mu: ArrayLike) -> None:
    """Check a coefficient of friction, or those with several sheets.

    Raises:
        ValueError: One is out of range.
    """
    values = np.asarray(mu, float)
    if values.ndim > 1 or not values.size or not ((values >= 0.0) & (values <= MU_MAX)).all():
        raise ValueError(f"mu: must be in [0, {MU_MAX:g}], one or one a sheet, got {values.tolist()}")


def plane(mu: ArrayLike, *, normal: ArrayLike = (0.0, 0.0, 1.0), origin: ArrayLike = ORIGIN) -> Body:
    """Return the half-space below a plane, with the axes of the world in the shortest turn from z to the normal."""
    n = np.asarray(normal, float)
    if n.shape != (3,) or not np.isfinite(n).all() or not n.any():
        raise ValueError(f"normal: must be three finite numbers, not all 0, got {n.tolist()}")
    n = n / np.linalg.norm(n)
    turn = np.diag([1.0, -1.0, -1.0])
    b = 1.0 + n[2] if n[2] > 0.0 else (n[0] ** 2 + n[1] ** 2) / (1.0 - n[2])
    if b > 0.0:
        a = -n[0] * n[1] / b
        turn = np.array([[1.0 - n[0] ** 2 / b, a, n[0]], [a, 1.0 - n[1] ** 2 / b, n[1]], [-n[0], -n[1], n[2]]])
    return Body(mu, 0, origin=origin, rotation=turn)


def sphere(mu: ArrayLike, radius: float, *, origin: ArrayLike = ORIGIN, rotation: ArrayLike = UPRIGHT) -> Body:
    """Return a ball. Cloth that sticks to it turns with it as its rotation (3, 3) changes from step to step."""
    check_positive(radius=radius)
    return Body(mu, 1, ORIGIN, radius, origin, rotation)


def cylinder(mu: ArrayLike, radius: float, *, origin: ArrayLike = ORIGIN, rotation: ArrayLike = UPRIGHT) -> Body:
    """Return a cylinder without ends, whose axis is the last column of its rotation (3, 3)."""
    check_positive(radius=radius)
    return Body(mu, 1, (0.0, 0.0, np.inf), radius, origin, rotation)


def capsule(
    mu: ArrayLike, radius: float, length: float, *, origin: ArrayLike = ORIGIN, rotation: ArrayLike = UPRIGHT
) -> Body:
    """Return a cylinder with half balls as ends, along the last column of its rotation (3, 3).

    `length` is that of the cylinder between the two half balls [m], `origin` its middle (3,) [m].
    """
    check_positive(length=length, radius=radius)
    return Body(mu, 1, (0.0, 0.0, 0.5 * length), radius, origin, rotation)


def box(
    mu: ArrayLike,
    size: ArrayLike,
    *,
    rounding: float | None = None,
    origin: ArrayLike = ORIGIN,
    rotation: ArrayLike = UPRIGHT,
) -> Body:
    """Return a box with edges of `size` (3,) [m], rounded with a radius [m]; None: 5 mm, or less for a thin box."""
    whole = np.asarray(size, float)
    if whole.shape != (3,) or not (np.isfinite(whole).all() and (whole > 0.0).all()):
        raise ValueError(f"size: must be three finite lengths > 0, got {size!r}")
    half = 0.5 * float(whole.min())
    radius = min(ROUNDING, half) if rounding is None else rounding
    check_positive(rounding=radius)
    if radius > half:
        raise ValueError(f"rounding: must be at most half the shortest edge, {half:g} m, got {radius:g}")
    a, b, c = (0.5 * whole - radius).tolist()
    return Body(mu, 1, (a, b, c), radius, origin, rotation)
