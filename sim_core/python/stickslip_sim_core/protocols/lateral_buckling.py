"""Lateral buckling: the weight at which a strip on edge turns sideways [Romero et al. 2021].

The strip is clamped with its width vertical. It takes up its weight in its plane, by steps of the
solver. The stiffness against motion out of the plane then has two parts: stress adds a part that is
proportional to the weight, and bending adds a part that is proportional to the rigidity. The flat
state loses stability at the weight for which the smallest eigenvalue of the sum is zero. This is an
eigenvalue problem for the weight. Both matrices are central differences of the solver's gradient.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import LinearOperator, eigsh, splu
from scipy.spatial import cKDTree

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.fabrics import isotropic
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.protocol import LENGTH, RefinedProtocol, Strip, strip
from stickslip_sim_core.reference import master_curves

ASPECT = (0.1, 0.2, 0.5)
POISSON = (0.0, 0.3)

DENSITY = 0.2  # kg/m^2
RIGIDITY = 1e-5  # N m
# Stiffness against stretching over rho_A g L: the strip sags by 1e-3 L at most.
STRETCHING = 1e5
# Share of a node's weight that is the unit of residuals.
FORCE_SHARE = 0.01
# Number of steps, after which inertia is negligible beside stiffness.
STEPS = 30
GROWTH = 1.5  # ratio of a time step to the step before
DIFFERENCE = 1e-7  # share of the length
# No force of bending acts between vertices that are further apart than this number of cells.
REACH = 6.0


@dataclass(kw_only=True, eq=False)
class LateralBuckling(RefinedProtocol):
    """The weight Gamma* at which flat strips lose stability.

    The master curve is `master_curves.lateral_buckling`.

    The preset's time step is the first one, and later steps grow.
    """

    name = "lateral-buckling"
    x_name = "w/L"
    y_name = "Gamma* = rho_A g L^3 / D"
    points = "aspect"
    parameters: ClassVar = {"mesh": "meshes", "poisson": "poisson"}
    time_step_name = "first_time_step"
    constants: ClassVar = {
        "stretching_over_weight": STRETCHING,
        "force_scale_over_node_weight": FORCE_SHARE,
    }

    aspect: Sequence[float] = ASPECT
    """Widths over length."""
    poisson: Sequence[float] = POISSON

    def measure_with(self, cells: int, x: float, at: Mapping[str, Any]) -> float:
        clamped = strip(x * LENGTH, cells, self.kinds[at["mesh"]])
        weight, cloth = threshold(clamped, at["poisson"], self.solver)
        self.tally.count(cloth)
        return weight

    def master(self, x: float, at: Mapping[str, Any]) -> float:
        return float(master_curves.lateral_buckling(x, at["poisson"]))


def threshold(clamped: Strip, poisson: float, preset: SolverSettings) -> tuple[float, Cloth]:
    """Return Gamma at which the flat strip, loaded in its plane, loses stability, and the cloth.

    Gamma is NaN if there is none.
    """
    # Before the first step no stress acts, so the first matrix has bending alone.
    cloth, flat = loaded(clamped, poisson, RIGIDITY, preset)
    held = clamped.held
    free = np.setdiff1d(np.arange(len(flat)), held)
    bending = out_of_plane(cloth, flat, free)
    for step in range(STEPS):
        cloth.step(preset.time_step * GROWTH**step, held=flat[held])
    stress = out_of_plane(cloth, cloth.positions, free) - bending
    if not np.isfinite(stress.data).all():
        return np.nan, cloth
    # bending + lambda stress is first singular at 1/lambda, the largest eigenvalue of -stress over
    # bending.
    inverse = LinearOperator(bending.shape, splu(bending).solve)
    # A random start would not give the same bits twice.
    start = np.ones(len(free))
    largest = float(
        eigsh(-stress, 1, M=bending, Minv=inverse, which="LA", v0=start, return_eigenvectors=False)[
            0
        ]
    )
    weight = DENSITY * GRAVITY * LENGTH**3 / RIGIDITY
    return float(weight / largest) if largest > 0.0 else np.nan, cloth


def loaded(
    clamped: Strip, poisson: float, rigidity: float, preset: SolverSettings
) -> tuple[Cloth, Floats]:
    """Return a flat strip at rest under its weight along its width, and its vertices (V, 3) [m]."""
    cloth = Cloth(
        clamped.mesh,
        isotropic(DENSITY, STRETCHING * DENSITY * GRAVITY * LENGTH, rigidity, poisson),
        preset,
        held=clamped.held,
        force_scale=FORCE_SHARE * DENSITY * GRAVITY * clamped.mesh.spacing**2,
    )
    flat = np.stack([clamped.along, clamped.across, np.zeros_like(clamped.along)], axis=1)
    cloth.set_state(flat)
    cloth.gravity[:] = [0.0, -GRAVITY, 0.0]
    return cloth, flat


def out_of_plane(cloth: Cloth, at: Floats, free: NDArray[np.int64]) -> csc_matrix:
    """Return the out-of-plane stiffness (F, F) of the free vertices of a flat cloth.

    Vertices that are more than twice `REACH` cells apart have no neighbour in common, so one
    difference moves all of them together.
    """
    rest = cloth.mesh.rest[free]
    cell = cloth.mesh.spacing
    period = int(np.ceil(2.0 * REACH)) + 1
    boxes = np.floor((rest - rest.min(axis=0)) / cell + 1e-6).astype(int)
    # Number of each vertex within its box. An unstructured mesh may have several in a box, which
    # must not move together.
    crowd = np.zeros(len(free), dtype=int)
    for box in np.unique(boxes, axis=0):
        inside = np.flatnonzero((boxes == box).all(axis=1))
        crowd[inside] = np.arange(len(inside))
    kinds = np.column_stack([boxes % period, crowd])
    groups = np.asarray(np.unique(kinds, axis=0, return_inverse=True)[1]).ravel()
    rows = []
    columns = []
    values = []
    for group in range(groups.max() + 1):
        members = np.flatnonzero(groups == group)
        ends = []
        for sign in (1.0, -1.0):
            moved = at.copy()
            moved[free[members], 2] += sign * DIFFERENCE * LENGTH
            ends.append(cloth._solver.energies(moved)[2][free, 2])
        # Each change of a force belongs to the nearest moved vertex, within its reach.
        distance, nearest = cKDTree(rest[members]).query(rest)
        near = np.flatnonzero(distance <= REACH * cell)
        rows.append(near)
        columns.append(members[np.asarray(nearest)[near]])
        values.append((ends[0] - ends[1])[near] / (2.0 * DIFFERENCE * LENGTH))
    whole = csc_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        (len(free), len(free)),
    )
    # A stiffness is symmetric, and differences are so up to rounding only.
    return csc_matrix(0.5 * (whole + whole.T))
