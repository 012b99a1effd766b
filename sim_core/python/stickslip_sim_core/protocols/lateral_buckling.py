"""Lateral buckling: the weight at which a strip clamped with its width vertical turns sideways [Romero et al. 2021].

The strip takes up its weight in its plane, by steps of the solver. What its stress then adds to the stiffness against
moving out of the plane goes with the weight, what bending adds with the rigidity: the flat state loses stability where
the smallest eigenvalue of their sum is zero, which is an eigenvalue problem for the weight. Both matrices are central
differences of the solver's own gradient.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.fabrics import isotropic
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.protocol import MeshedProtocol
from stickslip_sim_core.protocols.result import Setting
from stickslip_sim_core.protocols.strip import LENGTH, Strip, strip
from stickslip_sim_core.reference import master_curves

ASPECT = (0.1, 0.2, 0.5)
POISSON = (0.0, 0.3)

DENSITY, RIGIDITY = 0.2, 1e-5  # kg/m^2, N m
STRETCHING = 1e5  # over rho_A g L: the strip sags by 1e-3 L at most
FORCE_SHARE = 0.01  # of a node's weight: the force that residuals are measured in
STEPS, GROWTH = 30, 1.5  # of the time step, until inertia is nothing beside stiffness
DIFFERENCE = 1e-7  # of the length


@dataclass(kw_only=True, eq=False)
class LateralBuckling(MeshedProtocol):
    """The weight Gamma* at which flat strips lose stability, against `master_curves.lateral_buckling`.

    The preset's time step is the first one; the others grow.
    """

    name, x_name, y_name = "lateral-buckling", "w/L", "Gamma* = rho_A g L^3 / D"
    points, parameters = "aspect", {"mesh": "meshes", "poisson": "poisson"}
    time_step_name = "first_time_step"

    aspect: Sequence[float] = ASPECT
    """Widths over length."""
    poisson: Sequence[float] = POISSON
    cells: int = 50
    """Of a mesh along the strip."""
    structured: int = 2
    unstructured: int = 2
    tolerance: float = 0.03

    def measure(self, aspect: float, at: Mapping[str, Any]) -> tuple[float, float]:
        clamped = strip(aspect * LENGTH, self.cells, self.kinds[at["mesh"]])
        weight = threshold(clamped, at["poisson"], self.solver)
        return weight, float(master_curves.lateral_buckling(aspect, at["poisson"]))

    def reported(self) -> dict[str, Setting]:
        shares = {"stretching_over_weight": STRETCHING, "force_scale_over_node_weight": FORCE_SHARE}
        return super().reported() | shares


def threshold(clamped: Strip, poisson: float, preset: SolverSettings) -> float:
    """Return Gamma at which the flat strip, loaded in its plane, loses stability."""
    cloth, flat = loaded(clamped, poisson, RIGIDITY, preset)
    free = np.setdiff1d(np.arange(len(flat)), clamped.held)
    bending = out_of_plane(cloth, flat, free)
    for step in range(STEPS):
        cloth.step(preset.time_step * GROWTH**step, held=flat[clamped.held])
    stress = out_of_plane(cloth, cloth.positions, free) - bending
    if not np.isfinite(stress).all():
        return np.nan
    # bending + lambda stress is first singular at 1/lambda, the largest eigenvalue of L^-1 (-stress) L^-T.
    lower = np.linalg.cholesky(bending)
    half = np.linalg.solve(lower, -stress)
    turned = np.linalg.solve(lower, half.T)
    largest = float(np.linalg.eigvalsh(0.5 * (turned + turned.T))[-1])
    return float(DENSITY * GRAVITY * LENGTH**3 / RIGIDITY / largest) if largest > 0.0 else np.nan


def loaded(clamped: Strip, poisson: float, rigidity: float, preset: SolverSettings) -> tuple[Cloth, Floats]:
    """Return a flat strip at rest under its weight along its width, and its vertices (V, 3) [m]."""
    cloth = Cloth(
        clamped.mesh,
        isotropic(DENSITY, STRETCHING * DENSITY * GRAVITY * LENGTH, rigidity, poisson),
        preset,
        held=clamped.held,
        clamped=clamped.clamped,
        force_scale=FORCE_SHARE * DENSITY * GRAVITY * clamped.mesh.spacing**2,
    )
    flat = np.stack([clamped.along, clamped.across, np.zeros_like(clamped.along)], axis=1)
    cloth.set_state(flat, None, np.tile([-1.0, 0.0, 0.0], (len(clamped.clamped), 1)))
    cloth.gravity[:] = [0.0, -GRAVITY, 0.0]
    return cloth, flat


def out_of_plane(cloth: Cloth, at: Floats, free: NDArray[np.int64]) -> Floats:
    """Return the stiffness (F, F) of the free vertices of a flat cloth against moving out of its plane."""
    columns = np.empty((len(free), len(free)))
    moved = at.copy()
    for column, vertex in enumerate(free):
        ends = []
        for sign in (1.0, -1.0):
            moved[vertex, 2] = at[vertex, 2] + sign * DIFFERENCE * LENGTH
            ends.append(cloth._solver.energies(moved, cloth.slopes)[2][free, 2])
        moved[vertex, 2] = at[vertex, 2]
        columns[:, column] = (ends[0] - ends[1]) / (2.0 * DIFFERENCE * LENGTH)
    return 0.5 * (columns + columns.T)
