"""Meshes that protocols vary, and strips of cloth that are clamped along one short edge."""

from collections.abc import Sequence
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

MeshKind = Diagonals | int
"""Diagonals of a grid, or the seed of an unstructured mesh."""


def mesh_kinds(structured: int, unstructured: int) -> list[MeshKind]:
    """Return so many kinds of meshes: grids (at most 4) first."""
    return [*DIAGONALS[:structured], *range(unstructured)]


def mesh_names(kinds: Sequence[MeshKind]) -> str:
    """Return the numbered names of kinds of meshes, for the settings of a result."""
    return ", ".join(
        f"{i} {'unstructured' if isinstance(kind, int) else 'grid'} {kind}" for i, kind in enumerate(kinds)
    )


def rectangle(width: float, length: float, cells: tuple[int, int], spacing: float, kind: MeshKind, seed: int) -> Mesh:
    """Return a mesh of a rectangle [m]: a grid of `cells`, or triangles with sides of about `spacing` [m].

    `seed` draws the diagonals of a grid, and is added to the seed of an unstructured mesh.
    """
    if isinstance(kind, int):
        return meshes.unstructured(width, length, spacing, kind + seed)
    return meshes.grid(width, length, *cells, kind, seed=seed)


@dataclass(frozen=True, eq=False)
class Strip:
    """A strip along the second axis of its rest plane, clamped at its lower end."""

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


@lru_cache(maxsize=16)
def strip(width: float, cells: int, kind: MeshKind) -> Strip:
    """Return a strip of `width` [m] with `cells` cells along it."""
    spacing = LENGTH / cells
    shape = max(1, round(width / spacing)), cells
    mesh = rectangle(width, LENGTH, shape, spacing, kind, 0 if isinstance(kind, int) else 1)

    def root(p: Floats) -> NDArray[np.bool_]:
        below: NDArray[np.bool_] = p[:, 1] < (1e-9 - 0.5) * LENGTH
        return below

    tip = np.flatnonzero(mesh.rest[:, 1] > (0.5 - 1e-9) * LENGTH)
    return Strip(mesh, np.flatnonzero(root(mesh.rest)), mesh.boundary(root), tip)
