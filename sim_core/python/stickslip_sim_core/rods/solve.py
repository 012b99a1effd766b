"""Equilibria of suspended rods.

`solve_rods` solves the family (gamma, phi0, phi1), and `solve_general_rods` solves rods that vary
along their length.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core import _sim_core
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.rotations import quaternions_of_matrices
from stickslip_sim_core.splines import interpolation_matrix

Bools = NDArray[np.bool_]
Ints = NDArray[np.int32]

STIFFNESS = (2.0 / 3.0, 1.0, 1.0)
"""K = diag(C, 1, 1) of a round, incompressible rod: C = GJ/EI = 1/(1 + 1/2)."""

CLAMP_FRAME = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""Columns d1 = -z (along gravity), d2 = +x, d3 = -y: the clamp of `solve_rods`."""
CLAMP_FRAME.flags.writeable = False

ELEMENT_TURN_MAX = 2.5
"""Largest turn of an element of the coarsest level in the start of a search [rad].

See rods.hpp.
"""

RODS_AT_ONCE = 1024
"""Number of rods whose fields are on the solver's grid at once, which takes some 15 MB."""


@dataclass(frozen=True, eq=False)
class RodSolution:
    """Equilibria of n rods at `points` points of uniform arc length s = 0 ... 1.

    The clamp is at s = 0 and the free end at s = 1. Lengths are in units of the rod's length L, and
    moments in EI/L. The world has z up, gravity along -z, and the clamp at the origin with d1 = -z
    (along gravity), d2 = +x, d3 = -y. A rod that did not converge is NaN throughout.
    """

    centerline: Floats
    """Positions r(s) [L], shape (n, points, 3), with r' = d1."""

    curvature: Floats
    """Deformed curvature kappa(s) in the material frame [1/L], shape (n, points, 3).

    Its components are twist, bend about d2 and bend about d3. The natural curvature is (phi0, 0,
    phi1).
    """

    frame: Floats
    """Material frames R(s), shape (n, points, 3, 3).

    Column k, `frame[..., :, k]`, is d1 (tangent), d2 or d3 in world axes. R takes material
    components to world components, and R' = R [kappa]x.
    """

    energy: Floats
    """Elastic plus gravitational energy [EI/L], shape (n,).

    The gravitational part is zero for a rod that lies at z = 0 as a whole.
    """

    stable: Bools
    """Whether a rod converged to a strict local minimum, shape (n,).

    The Hessian on the finest level is then positive definite.
    """

    converged: Bools
    """Whether every level reached equilibrium and the levels agree, shape (n,)."""

    iterations: Ints
    """Evaluations of the Hessian over all levels, shape (n,)."""

    residual: Floats
    """Largest out-of-balance moment of a node before the last Newton step [EI/L], shape (n,).

    It is the value on the finest level.
    """

    refinement: Floats
    """Largest turn of a frame by the last term of the extrapolation [rad], shape (n,).

    The remaining error of `frame` was at most a quarter of it at 128 elements, and 2.3 times it at
    48 elements.
    """


def solve_rods(
    gamma: ArrayLike,
    phi0: ArrayLike,
    phi1: ArrayLike,
    *,
    poisson: float = 0.5,
    elements: int = 128,
    points: int = 150,
) -> RodSolution:
    """Compute the equilibrium that each rod reaches from its natural shape.

    The rod is a Kirchhoff rod, inextensible and unshearable, with a round section: K = diag(C, 1,
    1), C = GJ/EI = 1/(1 + poisson). It minimises its energy on a geodesic chain of frames with
    `elements`/4, /2 and /1 elements, and the three levels are extrapolated to the continuous rod
    [Bertails et al. 2006; Bertails-Descoubes et al. 2018, Sec. 3]. The bits of a rod depend on its
    three numbers and the settings, and not on the batch.

    Args:
        gamma: Weight against bending, rho A g L^3 / EI [-], shape (n,), >= 0. A number is a single
            rod.
        phi0: Natural twist times L [rad], shape (n,).
        phi1: Natural bend about d3 times L [rad], shape (n,).
        poisson: Poisson's ratio [-], in (-1, 0.5].
        elements: Elements of the finest level, a multiple of 4. The README has the largest errors
            of the centreline over gamma 100 ... 1300, phi0 0.2 ... 12, phi1 6 ... 20.
        points: Output points per rod, >= 2.

    Raises:
        ValueError: An argument breaks its rule. The message names the field, the rule and the
            value.
    """
    fields = {"gamma": gamma, "phi0": phi0, "phi1": phi1}
    gamma, phi0, phi1 = (
        finite_array(name, np.atleast_1d(values), (None,)) for name, values in fields.items()
    )
    if not gamma.size == phi0.size == phi1.size:
        raise ValueError(
            f"gamma, phi0, phi1: lengths must be equal, got {gamma.size}, {phi0.size}, {phi1.size}"
        )
    if (gamma < 0).any():
        raise ValueError(f"gamma: must be >= 0, got {gamma.min()}")
    if not -1.0 < poisson <= 0.5:
        raise ValueError(f"poisson: must be in (-1, 0.5], got {poisson}")
    check_count("elements", elements)
    check_count("points", points)
    result = _sim_core.solve_rods(gamma, phi0, phi1, 1.0 / (1.0 + poisson), elements, points)
    return RodSolution(*result)


def finite_array(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> Floats:
    """Return `values` as contiguous float64 of this shape, in which None is any extent."""
    array = np.asarray(values)
    if array.ndim != len(shape) or any(
        b not in (None, a) for a, b in zip(array.shape, shape, strict=True)
    ):
        asked = ", ".join("any" if extent is None else str(extent) for extent in shape)
        raise ValueError(f"{name}: must have shape ({asked}), got shape {array.shape}")
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: must be real numbers, got dtype {array.dtype}")
    array = np.ascontiguousarray(array, dtype=np.float64)
    wrong = np.argwhere(~np.isfinite(array))
    if wrong.size:
        index = ", ".join(map(str, wrong[0]))
        raise ValueError(f"{name}: must be finite, got {array[tuple(wrong[0])]} at index {index}")
    return array


def check_count(name: str, value: int) -> None:
    """Refuse a value that is no integer in 0 ... 2^24. The C++ core checks its exact range."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f"{name}: must be an integer, got {value!r}")
    if not 0 <= value < 2**24:
        raise ValueError(f"{name}: must be in 0 ... 2^24, got {value}")


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

    The function does the same as `solve_rods` for rods that vary along their length. The energy is
    int 1/2 (kappa - kappa_bar(s))^T K (kappa - kappa_bar(s)) + gamma (1 - s) t . e_z ds
    [Bertails-Descoubes et al. 2018, Sec. 3]. Natural curvature is the cubic spline (not-a-knot
    ends) through its samples, which must be dense enough for it. The fields of the solution have
    the same meanings and units, with `clamp_frame` as the frame of the clamp.

    Args:
        natural_curvature: Natural twist, bend about d2, bend about d3 [1/L] at m >= 1 points of
            uniform arc length, clamp and free end included, shape (n, m, 3). A single sample (m =
            1) is constant along the rod.
        gamma: Weight against bending, rho A g L^3 / EI with the reference stiffness EI [-], shape
            (n,), >= 0.
        stiffness: K = (GJ, EI_2, EI_3) / EI [-], > 0, shape (3,) for all rods or (n, 3).
        clamp_frame: Rotation R(0), columns d1 (tangent), d2, d3 in the world (z up), shape (3, 3)
            or (n, 3, 3).
        start_curvature: Curvature of the shape from which the search starts [1/L], shape (n, m',
            3). None is the natural curvature. Another start may reach another minimum.
        elements: Elements of the finest level, a multiple of 4.
        points: Output points per rod, >= 2.

    Raises:
        ValueError: An argument breaks its rule. The message names the field, the rule and the
            value.
    """
    natural = finite_array("natural_curvature", natural_curvature, (None, None, 3))
    n = len(natural)
    start = natural
    if start_curvature is not None:
        start = finite_array("start_curvature", start_curvature, (n, None, 3))
    for name, field in (("natural_curvature", natural), ("start_curvature", start)):
        if field.shape[1] < 1:
            raise ValueError(
                f"{name}: must have at least one sample along the rod, got shape {field.shape}"
            )
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
    to_grid = interpolation_matrix(m, grid)
    to_points = interpolation_matrix(m, output)
    to_slope = interpolation_matrix(m, nodes, derivative=1)
    start_to_grid = interpolation_matrix(start.shape[1], grid)
    parts = []
    # Even without rods the core runs once, which gives the result its fields.
    for begin in range(0, max(n, 1), RODS_AT_ONCE):
        batch = slice(begin, begin + RODS_AT_ONCE)
        fields = to_grid @ natural[batch]
        starts = fields if start is natural else start_to_grid @ start[batch]
        # The core checks the largest curvature against `elements`. Without rods it is 0.
        largest = max(np.linalg.norm(f, axis=2).max(initial=0.0) for f in (fields, starts))
        slope = to_slope @ natural[batch]
        at_points = to_points @ natural[batch]
        arrays = (weight[batch], K[batch], clamp[batch], fields, starts, slope, at_points)
        parts.append(_sim_core.solve_general_rods(*arrays, elements, largest))
    return RodSolution(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def rod_stiffness(stiffness: ArrayLike, n: int) -> Floats:
    """Return `stiffness` as (n, 3).

    Raises:
        ValueError: It has another shape, or a number in it is not > 0.
    """
    K = np.asarray(stiffness)
    K = finite_array("stiffness", np.broadcast_to(K, (n, 3)) if K.shape == (3,) else K, (n, 3))
    if (K <= 0).any():
        raise ValueError(f"stiffness: must be > 0, got {K.min()}")
    return K


def clamp_quaternions(clamp_frame: ArrayLike, n: int) -> Floats:
    """Return rotations (3, 3) or (n, 3, 3) as unit quaternions (w, x, y, z), shape (n, 4)."""
    R = np.asarray(clamp_frame)
    R = finite_array(
        "clamp_frame", np.broadcast_to(R, (n, 3, 3)) if R.shape == (3, 3) else R, (n, 3, 3)
    )
    error = np.abs(R.swapaxes(1, 2) @ R - np.eye(3)).max(initial=0.0)
    if error > 1e-8 or (np.linalg.det(R) < 0).any():
        determinant = np.linalg.det(R).min()
        raise ValueError(
            f"clamp_frame: must be a rotation, got R^T R - 1 = {error:.1e}, det {determinant:.3g}"
        )
    return quaternions_of_matrices(R)
