"""Strips of cloth that are clamped along one short edge: what their protocols share."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.meshes import Diagonals, Mesh

LENGTH = 0.1
"""Of every strip [m]."""

DIAGONALS: tuple[Diagonals, ...] = ("alternating", "random", "left", "right")


@dataclass(frozen=True, eq=False)
class Strip:
    """A strip along the second axis of its rest plane, clamped at its lower end."""

    name: str
    mesh: Mesh
    held: NDArray[np.int64]
    clamped: NDArray[np.int32]
    tip: NDArray[np.int64]

    @property
    def across(self) -> Floats:
        """(V,): distance from the long middle line [m]."""
        return self.mesh.rest[:, 0]

    @property
    def along(self) -> Floats:
        """(V,): distance from the clamp [m]."""
        return self.mesh.rest[:, 1] + LENGTH / 2.0


def strips(width: float, cells: int, structured: int, unstructured: int) -> Iterator[Strip]:
    """Yield so many strips of `width` [m] with `cells` cells along them, structured ones first."""
    spacing = LENGTH / cells
    columns = max(1, round(width / spacing))
    for diagonals in DIAGONALS[:structured]:
        yield _clamped(f"grid {diagonals}", meshes.grid(width, LENGTH, columns, cells, diagonals, seed=1))
    for seed in range(unstructured):
        yield _clamped(f"unstructured {seed}", meshes.unstructured(width, LENGTH, spacing, seed))


def _clamped(name: str, mesh: Mesh) -> Strip:
    def root(p: Floats) -> NDArray[np.bool_]:
        below: NDArray[np.bool_] = p[:, 1] < (1e-9 - 0.5) * LENGTH
        return below

    tip = np.flatnonzero(mesh.rest[:, 1] > (0.5 - 1e-9) * LENGTH)
    return Strip(name, mesh, np.flatnonzero(root(mesh.rest)), mesh.boundary(root), tip)
