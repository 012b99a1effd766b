"""The contract: the input of a simulator, and the class that an adapter offers.

SI units, float64, z is up. An adapter is a Python file with a class `Simulator`, which looks like
`Adapter` below. It imports nothing of this package: it runs in the environment of its simulator,
which needs Python 3.9 or newer and NumPy.

A class with less says less in `capabilities`. Experiments that need more are "not supported", which
is no fault.

| capability | meaning |
|---|---|
| held | the positions of the vertices `held` do not change |
| floor | the plane z = 0 with friction |
| planes | any plane, of any slope |
| cylinders | endless cylinders with friction |
| sheets | sheets touch each other, with friction |
| curved | `start` may be bent, while `rest` is flat |
| rods | `Rod` scenes |
"""

from __future__ import annotations  # Python 3.9 reads the types below as text

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CAPABILITIES = ("held", "floor", "planes", "cylinders", "sheets", "curved", "rods")

SETTINGS = ("default", "tuned")
"""Names of the two rows that a simulator may have."""


@dataclass(frozen=True)
class Body:
    """A fixed body that cloth touches."""

    kind: str
    """"plane", which fills the half-space behind its normal, or "cylinder", which is endless."""

    friction: float
    """Coefficient of friction mu with cloth."""

    point: tuple[float, float, float]
    """A point of the plane, or of the axis of the cylinder [m]."""

    direction: tuple[float, float, float]
    """Normal of the plane, out of the body, or direction of the axis: a unit vector."""

    radius: float = 0.0
    """Radius of the cylinder [m]."""


@dataclass(frozen=True)
class Sheet:
    """A scene with cloth: physics only. Time steps and iterations are the simulator's own."""

    rest: Floats
    """Flat shape without strain: (V, 2) [m]. Several sheets lie side by side."""

    start: Floats
    """Positions at time 0, at rest: (V, 3) [m]. Without strain, but for bending if "curved"."""

    triangles: NDArray[np.int32]
    """Vertices of each triangle, counter-clockwise in `rest`: (T, 3)."""

    sheet: NDArray[np.int32]
    """Number of the sheet of each vertex: (V,)."""

    cell: float
    """Length of a cell of the mesh [m]: the scale for contact distances and tolerances."""

    density: float
    """Mass per area [kg/m^2]. A vertex bears a third of each of its triangles."""

    stretching: float
    """Y = Young's modulus times thickness [N/m]. It is so large that strain does not matter."""

    bending: float
    """D = E h^3 / (12 (1 - poisson^2)) [N m]: moment per width over curvature."""

    poisson: float = 0.0

    held: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Vertices that stay where they start: (K,)."""

    bodies: tuple[Body, ...] = ()

    friction: float | None = None
    """Coefficient of friction between sheets. None: sheets do not meet."""

    gap: float = 5e-4
    """Distance between the middles of two sheets that touch [m]."""

    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """Acceleration at the start [m/s^2]. `set_gravity` changes it."""

    def masses(self) -> Floats:
        """Return the mass of each vertex (V,) [kg]: a third of each of its triangles."""
        first, second, third = np.moveaxis(self.rest[self.triangles], 1, 0)
        a = second - first
        b = third - first
        areas = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        shares = np.repeat(self.density * areas / 3.0, 3)
        masses = np.zeros(len(self.rest))
        np.add.at(masses, self.triangles.ravel(), shares)
        return masses

    def flat(self) -> Floats:
        """Return `rest` in three dimensions, at z = 0: (V, 3) [m]."""
        return np.column_stack([self.rest, np.zeros(len(self.rest))])

    def is_curved(self) -> bool:
        """Return whether a sheet starts bent or strained, and not as its rest shape moved."""
        for number in range(int(self.sheet.max()) + 1):
            chosen = self.sheet == number
            flat = self.flat()[chosen] - self.flat()[chosen].mean(axis=0)
            start = self.start[chosen] - self.start[chosen].mean(axis=0)
            # The best rotation has the left and right singular vectors of the covariance [Kabsch].
            u, _, v = np.linalg.svd(flat.T @ start)
            u[:, 2] *= np.sign(np.linalg.det(u @ v))
            if np.abs(flat @ u @ v - start).max() > 1e-6 * self.cell:
                return True
        return False


@dataclass(frozen=True)
class Rod:
    """A scene with a round, inextensible rod that is clamped at its first point."""

    length: float
    """L [m]."""

    elements: int
    """Number of elements. Positions are those of their elements + 1 ends."""

    density: float
    """Mass per length [kg/m]."""

    bending: float
    """EI [N m^2], the same in all directions."""

    twisting: float
    """GJ [N m^2]."""

    natural: tuple[float, float, float]
    """Twist and curvatures about d2 and d3 without load [1/m], constant along the rod."""

    clamp: Floats
    """Columns d1 (tangent), d2, d3 of the frame at the clamp, in the world: (3, 3)."""

    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """Acceleration [m/s^2]."""


class Adapter(Protocol):
    """The class `Simulator` of an adapter. Attributes stand in the class, `frame` in the instance.

    An exception from the constructor means "could not be set up", and from another method
    "failed". Both are printed. A scene runs in a process of its own.
    """

    name: str
    version: str
    capabilities: frozenset[str] | set[str]

    settings: dict[str, dict[str, Any]]
    """For each row, "default" or "tuned", the numbers and remarks that are printed.

    Of "tuned", `source` must name the page of the simulator's documentation.
    """

    clearance: float
    """Distance of a sheet's middle from a body that it rests on [m]. Optional, 0."""

    gap: float
    """Distance between the middles of two sheets that touch [m]. Optional, 5e-4."""

    frame: float
    """Time that one `step` covers [s]. Substeps are the simulator's own."""

    def __init__(self, scene: Sheet | Rod, setting: str) -> None:
        """Set the scene up, with the numerics of a row of `settings`."""

    def step(self) -> None:
        """Advance by `frame`."""

    def positions(self) -> Floats:
        """Return the positions of all vertices, in the order of the scene: (V, 3) [m]."""

    def set_gravity(self, gravity: Floats) -> None:
        """Change the acceleration of gravity (3,) [m/s^2]; it turns while a scene runs."""

    def damp(self, rate: float) -> None:
        """Slow all velocities down by exp(-rate t), with `rate` in 1/s, until the next call.

        Optional. Without it a scene that should settle runs longer.
        """
