"""Contact of cloth with rigid bodies, with itself and other cloth, and with triangle surfaces."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core._sim_core import compression, radius_least
from stickslip_sim_core.arrays import Floats, check_positive

ORTHONORMAL = 1e-6
"""Largest deviation of the scalar products of a rotation's axes from 0 or 1."""

MU_MAX = 10.0
"""Largest coefficient of friction."""

ROUNDING = 5e-3
"""Default radius of the edges of a box [m].

A box thinner than two of these radii has half its shortest edge as the radius.
"""

RADIUS_LEAST: float = radius_least
"""Least radius of a ball, a rod or the edges of a box, over the side of a cell.

On a sharper body friction is not right, so `Cloth` refuses it (`contact/bodies.hpp`).
"""

COMPRESSION: float = compression
"""Pressure that would close cloth between two bodies to nothing [Pa] (`contact/state.hpp`)."""

ORIGIN = (0.0, 0.0, 0.0)
UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Friction(NamedTuple):
    """Coefficients of friction of two things."""

    kinetic: float
    """While the contact slides."""

    static: float
    """While the contact rests."""


BodyTuple = tuple[int, list[float], Floats, float, Floats, Floats, list[float]]


@dataclass(frozen=True)
class Body:
    """A rigid body: a half-space, or all points within a radius of a core.

    The core is a box about the origin. It shrinks to a point for a sphere, to a segment for a
    capsule, and to an endless line for a cylinder.

    Raises:
        ValueError: `mu` is out of range, `origin` is not finite, or `rotation` is no rotation.
    """

    mu: ArrayLike
    """Coefficient of friction with the cloth, 0 ... 10, or with each of its sheets: (S,).

    With `mu_static` it is the kinetic one, of contacts that slide.
    """

    shape: int = 0
    """0 for a plane, which fills z < 0 in its own axes, or 1 for a rounded body.

    The numbers are those of `Body::Shape` in C++.
    """

    core: tuple[float, float, float] = ORIGIN
    """Half edges of the core along the body's own axes [m], 0 or more.

    An endless cylinder has inf along its axis.
    """

    radius: float = 0.0
    """Distance of the body's face from its core [m]."""

    origin: ArrayLike = ORIGIN
    """Origin of the body's axes in the world: (3,) [m]."""

    rotation: ArrayLike = UPRIGHT
    """Axes of the body in the world, as columns: (3, 3)."""

    mu_static: ArrayLike | None = None
    """Coefficient of friction of contacts at rest, as `mu`, and at least that.

    None is `mu`. `contact/friction_cones.hpp` has the rules.
    """

    def __post_init__(self) -> None:
        check_friction(self.mu)
        check_static_friction(self.mu, self.mu_static)
        origin = np.asarray(self.origin, float)
        turn = np.asarray(self.rotation, float)
        # A pose comes from a user's motion, so NaN and mirrored axes must stop here.
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise ValueError(f"origin: must be three finite numbers [m], got {origin.tolist()}")
        if (
            turn.shape != (3, 3)
            or not np.abs(turn @ turn.T - np.eye(3)).max() <= ORTHONORMAL
            or np.linalg.det(turn) < 0
        ):
            raise ValueError(
                f"rotation: must be orthonormal (3, 3) with determinant +1, got {turn.tolist()}"
            )

    @property
    def pose(self) -> Floats:
        """The motion x -> A x + b from the body's own axes to the world: (3, 4) [m]."""
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
            [] if self.mu_static is None else np.atleast_1d(self.mu_static).astype(float).tolist(),
        )


def check_friction(mu: ArrayLike) -> None:
    """Check a coefficient of friction, or one for each of several sheets.

    Raises:
        ValueError: A coefficient is out of range.
    """
    values = np.asarray(mu, float)
    if values.ndim > 1 or not values.size or not ((values >= 0.0) & (values <= MU_MAX)).all():
        raise ValueError(
            f"mu: must be in [0, {MU_MAX:g}], one or one a sheet, got {values.tolist()}"
        )


def check_static_friction(mu: ArrayLike, mu_static: ArrayLike | None) -> None:
    """Check the coefficients of friction of contacts at rest, if there are any.

    Raises:
        ValueError: A value is below that of sliding, or out of range, or the shapes differ.
    """
    if mu_static is None:
        return
    sliding = np.asarray(mu, float)
    resting = np.asarray(mu_static, float)
    if sliding.shape != resting.shape:
        raise ValueError(
            f"mu_static: must have the shape of mu, {sliding.shape}, got {resting.shape}"
        )
    # Otherwise cloth would hold less at rest than it does while it slides.
    if not ((resting >= sliding) & (resting <= MU_MAX)).all():
        raise ValueError(
            f"mu_static: must be in [mu, {MU_MAX:g}], and mu is {sliding.tolist()}, "
            f"got {resting.tolist()}"
        )


def plane(
    mu: ArrayLike, *, normal: ArrayLike = (0.0, 0.0, 1.0), origin: ArrayLike = ORIGIN
) -> Body:
    """Return the half-space below a plane.

    The axes of the body are the world's axes after the shortest turn from z to the normal.
    """
    n = np.asarray(normal, float)
    if n.shape != (3,) or not np.isfinite(n).all() or not n.any():
        raise ValueError(f"normal: must be three finite numbers, not all 0, got {n.tolist()}")
    n = n / np.linalg.norm(n)
    # A normal along -z has no shortest turn: a half turn about x is one of many.
    turn = np.diag([1.0, -1.0, -1.0])
    # b = 1 + n_z. The second form of it does not cancel for a normal close to -z.
    b = 1.0 + n[2] if n[2] > 0.0 else (n[0] ** 2 + n[1] ** 2) / (1.0 - n[2])
    if b > 0.0:
        a = -n[0] * n[1] / b
        turn = np.array(
            [[1.0 - n[0] ** 2 / b, a, n[0]], [a, 1.0 - n[1] ** 2 / b, n[1]], [-n[0], -n[1], n[2]]]
        )
    return Body(mu, 0, origin=origin, rotation=turn)


def sphere(
    mu: ArrayLike, radius: float, *, origin: ArrayLike = ORIGIN, rotation: ArrayLike = UPRIGHT
) -> Body:
    """Return a ball.

    Cloth that sticks to the ball turns with it as its rotation (3, 3) changes from step to step.
    """
    check_positive(radius=radius)
    return Body(mu, 1, ORIGIN, radius, origin, rotation)


def cylinder(
    mu: ArrayLike, radius: float, *, origin: ArrayLike = ORIGIN, rotation: ArrayLike = UPRIGHT
) -> Body:
    """Return an endless cylinder, whose axis is the last column of its rotation (3, 3)."""
    check_positive(radius=radius)
    return Body(mu, 1, (0.0, 0.0, np.inf), radius, origin, rotation)


def capsule(
    mu: ArrayLike,
    radius: float,
    length: float,
    *,
    origin: ArrayLike = ORIGIN,
    rotation: ArrayLike = UPRIGHT,
) -> Body:
    """Return a cylinder with half balls as ends, along the last column of its rotation (3, 3).

    `length` is the length of the cylinder between the two half balls [m]. `origin` is the middle of
    the capsule (3,) [m].
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
    """Return a box with edges of `size` (3,) [m], rounded with a radius [m].

    Without `rounding` the radius is 5 mm, or less for a thin box.
    """
    whole = np.asarray(size, float)
    if whole.shape != (3,) or not (np.isfinite(whole).all() and (whole > 0.0).all()):
        raise ValueError(f"size: must be three finite lengths > 0, got {size!r}")
    half = 0.5 * float(whole.min())
    # The faces of a thin box would meet before its edges had the default radius.
    radius = min(ROUNDING, half) if rounding is None else rounding
    check_positive(rounding=radius)
    if radius > half:
        raise ValueError(
            f"rounding: must be at most half the shortest edge, {half:g} m, got {radius:g}"
        )
    # `size` is the outer size. The radius grows the core by as much on every side.
    a, b, c = (0.5 * whole - radius).tolist()
    return Body(mu, 1, (a, b, c), radius, origin, rotation)


def default_rounding(size: ArrayLike, cell: float) -> float:
    """Return the radius of the edges of a box (3,) [m] in a scene that gives none [m].

    It is 5 mm or what cloth with cells of a side [m] slides over, but at most half the shortest
    edge.
    """
    return min(max(ROUNDING, RADIUS_LEAST * cell), 0.5 * float(np.min(size)))


THICKNESS = 5e-4
"""Default thickness of cloth in self-contact or in contact with a surface [m]."""

CREASE = float(np.radians(40.0))
"""Default angle from which edges of a surface stay sharp [rad]."""

SELF_FRICTION = 0.5
"""Default coefficient of friction of a cloth with itself in a scene.

It is the mean of the two coefficients of the thesis's shawls, 0.3 and 0.7 [thesis, Fig. 4.16].
"""

BEARING: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"all": (1.0, 1.0), "vertices": (0.9, 1.0), "first": (0.9, 0.9)}
)
"""Two shares of the thickness for each value of `SelfContact.bearing`.

Two sheets keep the first share between edges. They keep the second between vertices of the later
sheet and faces of the earlier sheet.
"""


@dataclass(frozen=True, eq=False)
class SelfContact:
    """Contact of cloth with itself and with other cloth.

    Nothing crosses, and friction obeys Coulomb's law exactly.

    Raises:
        ValueError: A number breaks its rule.
    """

    mu: float | ArrayLike
    """Coefficient of friction, 0 ... 10, or one for each pair of sheets: (S, S), symmetric.

    Sheets are the connected pieces of the mesh, in the order of their first vertices.
    """

    thickness: float | ArrayLike = THICKNESS
    """Thickness of all sheets [m], or of each sheet: (S,).

    The middles of two sheets stay the mean of their thicknesses apart. A sheet must be thinner than
    the distance at rest between any of its vertices and edges that do not meet.
    """

    bearing: str = "all"
    """Contacts that keep two sheets the full thickness apart. The other contacts keep 0.9 of it.

    "all": vertices, and edges that cross. "vertices": vertices of both sheets. "first": vertices of
    the earlier sheet.

    "vertices" and "first" converge in fewer iterations if sheets lie on each other over large,
    smooth faces. Choose "first" only for flat faces, because its forces are rough over curved
    cloth. Within a sheet all contacts keep the full thickness.
    """

    mu_static: float | ArrayLike | None = None
    """Coefficient of friction of contacts at rest, as `mu`, and at least that.

    None is `mu`.
    """

    def __post_init__(self) -> None:
        if self.bearing not in BEARING:
            raise ValueError(f"bearing: must be one of {', '.join(BEARING)}, got {self.bearing!r}")
        mu = np.asarray(self.mu, float)
        if not ((mu >= 0.0) & (mu <= MU_MAX)).all():
            raise ValueError(f"mu: must be in [0, {MU_MAX:g}], got {mu.tolist()}")
        # A pair of sheets has no order, so it cannot have two coefficients.
        if mu.ndim and not (mu.ndim == 2 and mu.shape[0] == mu.shape[1] and (mu == mu.T).all()):
            raise ValueError(f"mu: must be a number or a symmetric matrix, got {mu.tolist()}")
        check_static_friction(self.mu, self.mu_static)
        resting = np.asarray(self.mu if self.mu_static is None else self.mu_static, float)
        if not (resting == resting.T).all():
            raise ValueError(
                f"mu_static: must be a number or a symmetric matrix, got {resting.tolist()}"
            )
        thickness = np.asarray(self.thickness, float)
        if thickness.ndim > 1 or not (np.isfinite(thickness) & (thickness > 0.0)).all():
            raise ValueError(
                f"thickness: must be finite and > 0, one or one a sheet, got {thickness.tolist()}"
            )

    def of_sheets(self, sheets: int) -> tuple[Floats, Floats, Floats]:
        """Return kinetic and static friction (S, S) and thicknesses (S,) [m] of S sheets.

        Raises:
            ValueError: `mu` or `thickness` has another number of sheets.
        """
        # Only the mesh gives the number of sheets, so `__post_init__` could not check it.
        mu = np.asarray(self.mu, float)
        thickness = np.asarray(self.thickness, float)
        if mu.ndim and mu.shape != (sheets, sheets):
            raise ValueError(f"mu: must be of {sheets} sheets, got {mu.tolist()}")
        if thickness.ndim and thickness.shape != (sheets,):
            raise ValueError(f"thickness: must be of {sheets} sheets, got {thickness.tolist()}")
        resting = mu if self.mu_static is None else np.asarray(self.mu_static, float)
        return (
            np.broadcast_to(mu, (sheets, sheets)).copy(),
            np.broadcast_to(resting, (sheets, sheets)).copy(),
            np.broadcast_to(thickness, sheets).copy(),
        )


@dataclass(frozen=True, eq=False)
class Surface:
    """A body of any shape: triangles with prescribed motion, which cloth touches from either side.

    The surface may be open or closed, cross itself, and bend as it moves. It has no inside: cloth
    stays on the side of its start.

    Vertices of the cloth touch a smooth surface through the vertices of the triangles, as they
    touch a body. Between its vertices the cloth keeps a quarter of that distance from the
    triangles, by pairs of closest points (see `SelfContact`). Nothing crosses the triangles.

    Raises:
        ValueError: An argument breaks its rule.
    """

    triangles: ArrayLike
    """Vertices of each triangle: (T, 3)."""

    positions: ArrayLike | Callable[[float], ArrayLike]
    """Positions of the vertices (N, 3) [m], or a function of the time [s] that returns them.

    Within a step vertices move on straight lines.
    """

    mu: float | ArrayLike
    """Coefficient of friction with the cloth, 0 ... 10, or with each of its sheets: (S,)."""

    thickness: float = THICKNESS
    """Thickness of a skin around the triangles, half of it on each side [m]. It may be 0.

    Cloth stays half of this thickness and half of its own thickness away from the triangles.
    """

    crease: float = CREASE
    """Angle between the normals of two triangles from which their edge stays sharp [rad].

    The angle is 0 ... pi, and the normals are taken at time 0. Borders are sharp.
    """

    mu_static: float | ArrayLike | None = None
    """Coefficient of friction of contacts at rest, as `mu`, and at least that.

    None is `mu`.
    """

    def __post_init__(self) -> None:
        check_friction(self.mu)
        check_static_friction(self.mu, self.mu_static)
        if not (np.isfinite(self.thickness) and self.thickness >= 0.0):
            raise ValueError(f"thickness: must be finite and >= 0, got {self.thickness}")
        if not 0.0 <= self.crease <= np.pi:
            raise ValueError(f"crease: must be in [0, pi] rad, got {self.crease}")
        triangles = np.array(self.triangles, dtype=np.int32)
        if triangles.ndim != 2 or triangles.shape[1] != 3 or not len(triangles):
            raise ValueError(
                f"triangles: must be (T, 3) numbers of vertices, got shape {triangles.shape}"
            )
        # A frozen dataclass allows no plain assignment.
        object.__setattr__(self, "triangles", triangles)
        corners = self.at(0.0)
        if triangles.min() < 0 or triangles.max() >= len(corners):
            raise ValueError(
                f"triangles: must index {len(corners)} vertices, "
                f"got {triangles.min()} ... {triangles.max()}"
            )
        # A triangle without an area has no normal.
        a, b, c = np.moveaxis(corners[triangles], 1, 0)
        flat = np.flatnonzero(np.linalg.norm(np.cross(b - a, c - a), axis=1) == 0.0)
        if len(flat):
            raise ValueError(f"triangles: must have an area, and triangle {flat[0]} has none")

    def at(self, time: float) -> Floats:
        """Return the positions of the vertices at a time [s]: (N, 3) [m].

        Raises:
            ValueError: The positions are not (N, 3) or not finite.
        """
        # A user's function may return lists, or other numbers at some times: check every time.
        positions = np.ascontiguousarray(
            self.positions(time) if callable(self.positions) else self.positions, dtype=float
        )
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ValueError(
                f"positions: must be (N, 3), got shape {positions.shape} at {time:g} s"
            )
        if not np.isfinite(positions).all():
            raise ValueError(f"positions: must be finite, and are not at {time:g} s")
        return positions
