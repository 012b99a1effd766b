"""Contact of cloth with itself, with other cloth and with surfaces of triangles."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.bodies import MU_MAX, check_friction

THICKNESS = 5e-4
"""Default thickness of cloth in self-contact or in contact with a surface [m]."""


CREASE = float(np.radians(40.0))
"""Default angle from which edges of a surface stay sharp [rad]."""


SELF_FRICTION = 0.5
"""Default coefficient of friction of a cloth with itself in a scene: the mean of the two of the thesis's shawls, 0.3
and 0.7 [thesis, Fig. 4.16]."""


BEARING: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"all": (1.0, 1.0), "vertices": (0.9, 1.0), "first": (0.9, 0.9)}
)
"""Shares of the thickness that two sheets keep between edges, and between vertices of the later and faces of the
earlier: see `SelfContact.bearing`."""


@dataclass(frozen=True, eq=False)
class SelfContact:
    """Contact of cloth with itself and other cloth, without crossings and with exact Coulomb friction.

    Raises:
        ValueError: A number breaks its rule.
    """

    mu: float | ArrayLike
    """Coefficient of friction, 0 ... 10, or one for each pair of sheets: (S, S), symmetric. Sheets are the connected
    pieces of the mesh, in the order of their first vertices."""

    thickness: float | ArrayLike = THICKNESS
    """Of all sheets [m], or of each: (S,). The middles of two sheets stay the mean of their thicknesses apart. A sheet
    must be thinner than the distance at rest between any of its vertices and edges that do not meet."""

    bearing: str = "all"
    """Contacts that keep two sheets the full thickness apart; the others keep 0.9 of it. "all": vertices, and edges
    that cross. "vertices": vertices of both sheets. "first": vertices of the earlier sheet. Where sheets lie on
    each other over large, smooth faces, "vertices" and "first" converge in fewer iterations. Choose "first" only
    where these are flat: over curved cloth its forces are rough. Within a sheet all contacts keep the full
    thickness."""

    def __post_init__(self) -> None:
        if self.bearing not in BEARING:
            raise ValueError(f"bearing: must be one of {', '.join(BEARING)}, got {self.bearing!r}")
        mu = np.asarray(self.mu, float)
        if not ((mu >= 0.0) & (mu <= MU_MAX)).all():
            raise ValueError(f"mu: must be in [0, {MU_MAX:g}], got {mu.tolist()}")
        if mu.ndim and not (mu.ndim == 2 and mu.shape[0] == mu.shape[1] and (mu == mu.T).all()):
            raise ValueError(f"mu: must be a number or a symmetric matrix, got {mu.tolist()}")
        thickness = np.asarray(self.thickness, float)
        if thickness.ndim > 1 or not (np.isfinite(thickness) & (thickness > 0.0)).all():
            raise ValueError(f"thickness: must be finite and > 0, one or one a sheet, got {thickness.tolist()}")

    def of_sheets(self, sheets: int) -> tuple[Floats, Floats]:
        """Return friction (S, S) and thicknesses (S,) [m] of S sheets.

        Raises:
            ValueError: `mu` or `thickness` is of another number of sheets.
        """
        mu, thickness = np.asarray(self.mu, float), np.asarray(self.thickness, float)
        if mu.ndim and mu.shape != (sheets, sheets):
            raise ValueError(f"mu: must be of {sheets} sheets, got {mu.tolist()}")
        if thickness.ndim and thickness.shape != (sheets,):
            raise ValueError(f"thickness: must be of {sheets} sheets, got {thickness.tolist()}")
        return np.broadcast_to(mu, (sheets, sheets)).copy(), np.broadcast_to(thickness, sheets).copy()


@dataclass(frozen=True, eq=False)
class Surface:
    """A body of any shape: triangles with prescribed motion, which cloth touches from either side.

    It may be open or closed, cross itself, and bend as it moves. It has no inside: cloth stays on the side where it
    starts.

    Vertices of the cloth touch a smooth surface through the vertices of the triangles, as they touch a body. Between
    its vertices the cloth keeps a quarter of that distance from the triangles, by pairs of closest points (see
    `SelfContact`). Nothing crosses the triangles.

    Raises:
        ValueError: An argument breaks its rule.
    """

    triangles: ArrayLike
    """(T, 3): vertices of each triangle."""

    positions: ArrayLike | Callable[[float], ArrayLike]
    """(N, 3) [m], or a function of the time [s] that returns them. Within a step vertices move on straight lines."""

    mu: float | ArrayLike
    """Coefficient of friction with the cloth, 0 ... 10, or with each of its sheets: (S,)."""

    thickness: float = THICKNESS
    """Of a skin around the triangles, half of it on each side [m]: cloth stays half of this and half of its own
    thickness away from them. May be 0."""

    crease: float = CREASE
    """Edges stay sharp where the normals of their triangles are further apart at time 0, 0 ... pi [rad]. Borders are
    sharp."""

    def __post_init__(self) -> None:
        check_friction(self.mu)
        if not (np.isfinite(self.thickness) and self.thickness >= 0.0):
            raise ValueError(f"thickness: must be finite and >= 0, got {self.thickness}")
        if not 0.0 <= self.crease <= np.pi:
            raise ValueError(f"crease: must be in [0, pi] rad, got {self.crease}")
        triangles = np.array(self.triangles, dtype=np.int32)
        if triangles.ndim != 2 or triangles.shape[1] != 3 or not len(triangles):
            raise ValueError(f"triangles: must be (T, 3) numbers of vertices, got shape {triangles.shape}")
        object.__setattr__(self, "triangles", triangles)
        corners = self.at(0.0)
        if triangles.min() < 0 or triangles.max() >= len(corners):
            raise ValueError(
                f"triangles: must index {len(corners)} vertices, got {triangles.min()} ... {triangles.max()}"
            )
        a, b, c = np.moveaxis(corners[triangles], 1, 0)
        flat = np.flatnonzero(np.linalg.norm(np.cross(b - a, c - a), axis=1) == 0.0)
        if len(flat):
            raise ValueError(f"triangles: must have an area, and triangle {flat[0]} has none")

    def at(self, time: float) -> Floats:
        """Return the positions of the vertices at a time [s]: (N, 3) [m].

        Raises:
            ValueError: They are not (N, 3) or not finite.
        """
        found = np.ascontiguousarray(self.positions(time) if callable(self.positions) else self.positions, dtype=float)
        if found.ndim != 2 or found.shape[1] != 3:
            raise ValueError(f"positions: must be (N, 3), got shape {found.shape} at {time:g} s")
        if not np.isfinite(found).all():
            raise ValueError(f"positions: must be finite, and are not at {time:g} s")
        return found
