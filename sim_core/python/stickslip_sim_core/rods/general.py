"""Equilibria of suspended rods beyond three numbers: natural curvature along s, three stiffnesses, any clamp."""

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core import _sim_core
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.rods.solve import RodSolution, check_count, finite_array
from stickslip_sim_core.rods.splines import interpolation_matrix

STIFFNESS = (2.0 / 3.0, 1.0, 1.0)
"""K = diag(C, 1, 1) of a round, incompressible rod: C = GJ/EI = 1/(1 + 1/2)."""

CLAMP_FRAME = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""Columns d1 = -z (along gravity), d2 = +x, d3 = -y: the clamp of `solve_rods`."""
CLAMP_FRAME.flags.writeable = False

ELEMENT_TURN_MAX = 2.5
"""Largest turn of an element of the coarsest level in the shape that the search starts from [rad]; see rods.hpp."""

RODS_AT_ONCE = 1024
"""Rods whose fields are on the solver's grid at once: some 15 MB."""


def solve_general_rods(
    natural_curvature: ArrayLike,
    gamma: ArrayLike,
    *,
    stiffness: ArrayLike = STIFFNESS,
    clamp_frame: ArrayLike = CLAMP_FRAME,
    start_curvature: ArrayLike | None = None,
    elements: int = 128,
    points: int = 150,
) -> RodSolution:
    """Compute the equilibrium that each rod reaches from its natural shape, or from another start.

    As `solve_rods`, for rods that differ along their length: the energy is int 1/2 (kappa - kappa_bar(s))^T K
    (kappa - kappa_bar(s)) + gamma (1 - s) t . e_z ds [Bertails-Descoubes et al. 2018, Sec. 3]. Natural curvature is
    the cubic spline (not-a-knot ends) through its samples; sample it finely enough for that. What the fields of the
    solution mean, and its units, is the same; the clamp's frame is `clamp_frame`.

    Args:
        natural_curvature: Natural twist, bend about d2, bend about d3 [1/L] at m >= 1 points of uniform arc length
            (clamp ... free end, both included), shape (n, m, 3). m = 1: constant along the rod.
        gamma: Weight against bending, rho A g L^3 / EI with the reference stiffness EI [-], shape (n,), >= 0.
        stiffness: K = (GJ, EI_2, EI_3) / EI [-], > 0, shape (3,) for all rods or (n, 3).
        clamp_frame: Rotation R(0), columns d1 (tangent), d2, d3 in the world (z up), shape (3, 3) or (n, 3, 3).
        start_curvature: Curvature of the shape from which the search starts [1/L], shape (n, m', 3); None: the natural
            curvature. Another start may reach another minimum.
        elements: Elements of the finest level, a multiple of 4.
        points: Output points per rod, >= 2.

    Raises:
        ValueError: An argument breaks its rule; the message names the field, the rule and the value.
    """
    natural = finite_array("natural_curvature", natural_curvature, (None, None, 3))
    n = len(natural)
    start = natural
    if start_curvature is not None:
        start = finite_array("start_curvature", start_curvature, (n, None, 3))
    for name, field in (("natural_curvature", natural), ("start_curvature", start)):
        if field.shape[1] < 1:
            raise ValueError(f"{name}: must have at least one sample along the rod, got shape {field.shape}")
    weight = finite_array("gamma", gamma, (n,))
    if (weight < 0).any():
        raise ValueError(f"gamma: must be >= 0, got {weight.min()}")
    K = rod_stiffness(stiffness, n)
    clamp = clamp_quaternions(clamp_frame, n)
    check_count("elements", elements)
    check_count("points", points)

    grid = np.linspace(0.0, 1.0, 2 * elements + 1)
    nodes = np.linspace(0.0, 1.0, elements // 2 + 1)
    output = np.linspace(0.0, 1.0, points)
    m = natural.shape[1]
    to_grid, to_points = interpolation_matrix(m, grid), interpolation_matrix(m, output)
    to_slope = interpolation_matrix(m, nodes, derivative=1)
    start_to_grid = interpolation_matrix(start.shape[1], grid)
    parts = []
    for begin in range(0, max(n, 1), RODS_AT_ONCE):
        some = slice(begin, begin + RODS_AT_ONCE)
        fields = to_grid @ natural[some]
        starts = fields if start is natural else start_to_grid @ start[some]
        # The core checks it against `elements`. None is the largest of no rods.
        largest = max(np.linalg.norm(f, axis=2).max(initial=0.0) for f in (fields, starts))
        slope, at_points = to_slope @ natural[some], to_points @ natural[some]
        arrays = (weight[some], K[some], clamp[some], fields, starts, slope, at_points)
        parts.append(_sim_core.solve_general_rods(*arrays, elements, largest))
    return RodSolution(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def rod_stiffness(stiffness: ArrayLike, n: int) -> Floats:
    """Return `stiffness` as (n, 3), checked."""
    K = np.asarray(stiffness)
    K = finite_array("stiffness", np.broadcast_to(K, (n, 3)) if K.shape == (3,) else K, (n, 3))
    if (K <= 0).any():
        raise ValueError(f"stiffness: must be > 0, got {K.min()}")
    return K


def clamp_quaternions(clamp_frame: ArrayLike, n: int) -> Floats:
    """Return rotations (3, 3) or (n, 3, 3) as unit quaternions (w, x, y, z), shape (n, 4)."""
    R = np.asarray(clamp_frame)
    R = finite_array("clamp_frame", np.broadcast_to(R, (n, 3, 3)) if R.shape == (3, 3) else R, (n, 3, 3))
    error = np.abs(R.swapaxes(1, 2) @ R - np.eye(3)).max(initial=0.0)
    if error > 1e-8 or (np.linalg.det(R) < 0).any():
        raise ValueError(
            f"clamp_frame: must be a rotation, got R^T R - 1 = {error:.1e}, det {np.linalg.det(R).min():.3g}"
        )
    from scipy.spatial.transform import Rotation  # here, so that importing the package stays quick

    return np.ascontiguousarray(np.roll(Rotation.from_matrix(R).as_quat(), 1, axis=1)) if n else np.empty((0, 4))
