"""Strips that are drawn over cylinders of triangles and of cloth.

The capstan protocol has a round cylinder.
"""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from stickslip_sim_core import Cloth, Fabric, SelfContact, SolverSettings, Surface
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import THICKNESS
from stickslip_sim_core.protocols import capstan

Floats = NDArray[np.float64]


class OverTriangles(capstan.Strip):
    """A strip over a cylinder of so many flat faces, all around."""

    apart: ClassVar[float] = 0.01

    def __init__(
        self,
        mu: float,
        bending: float,
        preset: SolverSettings,
        facets: int,
        cells_per_turn: int = capstan.CELLS_PER_TURN,
    ) -> None:
        self.facets = facets
        super().__init__(mu, bending, preset, cells_per_turn)

    def over(self, mu: float, mesh: meshes.Mesh, material: Fabric, force_scale: float) -> Cloth:
        around = tube(self.facets, capstan.WIDTH * self.cell, mu)
        return Cloth(
            mesh, material, self.preset, held=self.held, surfaces=[around], force_scale=force_scale
        )


class OverCloth(OverTriangles):
    """The triangles are those of another cloth, all of whose vertices are held."""

    apart = 0.1

    def over(self, mu: float, mesh: meshes.Mesh, material: Fabric, force_scale: float) -> Cloth:
        sheet, self.below = cover(self.facets, (capstan.WIDTH + 2) * self.cell)
        return Cloth(
            meshes.together(mesh, sheet),
            material,
            self.preset,
            held=np.append(self.held, len(mesh.rest) + np.arange(len(self.below))),
            self_contact=SelfContact(mu, bearing="vertices"),
            force_scale=force_scale,
        )


def tube(facets: int, breadth: float, mu: float) -> Surface:
    """Return a cylinder of triangles along y, wider than such a strip.

    The middles of its edges touch at the radius.
    """
    angle = 2.0 * np.pi * np.arange(facets) / facets
    ring = (capstan.RADIUS - THICKNESS) * np.column_stack(
        [np.cos(angle), 0.0 * angle, np.sin(angle)]
    )
    i = np.arange(facets)
    j = (i + 1) % facets
    triangles = np.concatenate(
        [np.column_stack([i, j, facets + i]), np.column_stack([j, facets + j, facets + i])]
    )
    return Surface(
        triangles,
        np.concatenate([ring + np.array([0.0, s * breadth, 0.0]) for s in (-1.0, 1.0)]),
        mu,
    )


def cover(facets: int, breadth: float) -> tuple[meshes.Mesh, Floats]:
    """Return a sheet around the strip's arc and 30 degrees more, and its vertices (V, 3) [m]."""
    angle = 2.0 * np.pi / facets
    cells = int(np.ceil((capstan.WRAP + np.pi / 6.0) / angle))
    radius = capstan.RADIUS - THICKNESS
    mesh = meshes.grid(
        cells * angle * radius, breadth, cells, max(2, round(breadth / (angle * radius)))
    )
    at = 0.5 * capstan.WRAP + mesh.rest[:, 0] / radius
    return mesh, np.column_stack([-radius * np.cos(at), mesh.rest[:, 1], radius * np.sin(at)])
