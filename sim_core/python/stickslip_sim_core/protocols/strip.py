"""Meshes that protocols vary, and strips of cloth that are clamped along one short edge."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.meshes import Diagonals, Mesh

LENGTH = 0.1
"""Of every strip [m]."""

DIAGONALS: tuple[Diagonals, ...] = ("alternating", "random", "left", "right")

ALIGNED = 3
"""Rows of square cells at the clamp of an unstructured strip. With one, the tip of a cantilever is off by 2.4 %."""

MeshKind = Diagonals | int
"""Diagonals of a grid, or the seed of an unstructured mesh."""


def rectangle(
    width: float, length: float, cells: tuple[int, int], spacing: float, kind: MeshKind, seed: int, aligned: int = 0
) -> Mesh:
    """Return a mesh of a rectangle [m]: a grid of `cells`, or triangles with sides of about `spacing` [m].

    `seed` draws the diagonals of a grid, and is added to the seed of an unstructured mesh, of which `aligned` rows of
    cells at the lower end are those of a grid.
    """
    if isinstance(kind, int):
        return meshes.unstructured(width, length, spacing, kind + seed, aligned=aligned)
    return meshes.grid(width, length, *cells, kind, seed=seed)


@dataclass(frozen=True, eq=False)
class Strip:
    """A strip along the second axis of its rest plane, clamped at its lower end by two rows of vertices.

    The rows lie half a cell before and behind the clamp, so that a strip that is straight between them is level at the
    clamp itself. The mesh is longer than the strip by half a cell.
    """

    mesh: Mesh
    cell: float
    """Length of a cell along the strip [m]."""

    @property
    def across(self) -> Floats:
        """(V,): distance from the long middle line [m]."""
        return self.mesh.rest[:, 0]

    @property
    def along(self) -> Floats:
        """(V,): distance from the clamp [m], negative in the first row."""
        return self.mesh.rest[:, 1] + 0.5 * (LENGTH - 0.5 * self.cell)

    @property
    def held(self) -> NDArray[np.int64]:
        """Vertices of the two rows."""
        return np.flatnonzero(self.along < 0.75 * self.cell)

    @property
    def tip(self) -> NDArray[np.int64]:
        """Vertices of the free end."""
        return np.flatnonzero(self.along > LENGTH - 0.25 * self.cell)


def cell_of(cells: int) -> float:
    """Return the length of a cell [m] of a strip with `cells` cells along it, half of one of them before the clamp."""
    return LENGTH / (cells - 0.5)


@lru_cache(maxsize=16)
def strip(width: float, cells: int, kind: MeshKind) -> Strip:
    """Return a strip of `width` [m] with `cells` cells along it."""
    cell = cell_of(cells)
    shape = max(1, round(width / cell)), cells
    seed = 0 if isinstance(kind, int) else 1
    return Strip(rectangle(width, LENGTH + 0.5 * cell, shape, cell, kind, seed, ALIGNED), cell)
