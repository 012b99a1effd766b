"""Equilibria of suspended rods: the family (gamma, phi0, phi1) of clamped, hanging, naturally curled rods."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core import _sim_core
from stickslip_sim_core.arrays import Floats

Bools = NDArray[np.bool_]
Ints = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class RodSolution:
    """Equilibria of n rods at `points` points of uniform arc length s = 0 ... 1 (clamp ... free end, both included).

    Lengths are in units of the rod's length L, moments in EI/L. The world has z up, gravity along -z, and the clamp at
    the origin with d1 = -z (along gravity), d2 = +x, d3 = -y. A rod that did not converge is NaN throughout.
    """

    centerline: Floats
    """Positions r(s) [L], shape (n, points, 3); r' = d1."""

    curvature: Floats
    """Deformed curvature kappa(s) = (twist, bend about d2, bend about d3) [1/L] in the material frame, shape
    (n, points, 3). The natural curvature is (phi0, 0, phi1)."""

    frame: Floats
    """Material frames R(s), shape (n, points, 3, 3): `frame[..., :, k]`, column k, is d1 (tangent), d2 or d3 in world
    axes, so that R takes material components to world components and R' = R [kappa]x."""

    energy: Floats
    """Elastic plus gravitational energy [EI/L], shape (n,); the gravitational part is zero for a rod all at z = 0."""

    stable: Bools
    """Converged, and the Hessian on the finest level is positive definite, shape (n,): a strict local minimum."""

    converged: Bools
    """Every level reached equilibrium and the levels agree, shape (n,)."""

    iterations: Ints
    """Evaluations of the Hessian over all levels, shape (n,)."""

    residual: Floats
    """Largest out-of-balance nodal moment on the finest level before the last Newton step [EI/L], shape (n,)."""

    refinement: Floats
    """Largest turn of a frame by the last term of the extrapolation [rad], shape (n,). The error left in `frame` was
    at most a quarter of it at 128 elements, and 2.3 times it at 48."""


def solve_rods(
    gamma: ArrayLike, phi0: ArrayLike, phi1: ArrayLike, *, poisson: float = 0.5, elements: int = 128, points: int = 150
) -> RodSolution:
    """Compute the equilibrium that each rod reaches from its natural shape.

    A Kirchhoff rod, inextensible and unshearable with K = diag(C, 1, 1), C = GJ/EI = 1/(1 + poisson) (round section),
    minimises its energy on a geodesic chain of frames with `elements`/4, /2 and /1 elements; the three levels are
    extrapolated to the continuous rod [Bertails et al. 2006; Bertails-Descoubes et al. 2018, Sec. 3]. A rod's bits
    depend on its own three numbers and the settings only, not on the batch.

    Args:
        gamma: Weight against bending, rho A g L^3 / EI [-], shape (n,), >= 0; one number is a single rod.
        phi0: Natural twist times L [rad], shape (n,).
        phi1: Natural bend about d3 times L [rad], shape (n,).
        poisson: Poisson's ratio [-], in (-1, 0.5].
        elements: Elements of the finest level, a multiple of 4. Largest centreline error over gamma 100 ... 1300,
            phi0 0.2 ... 12, phi1 6 ... 20: see the README.
        points: Output points per rod, >= 2.

    Raises:
        ValueError: An argument breaks its rule; the message names the field, the rule and the value.
    """
    fields = {"gamma": gamma, "phi0": phi0, "phi1": phi1}
    gamma, phi0, phi1 = (finite_array(name, np.atleast_1d(values), (None,)) for name, values in fields.items())
    if not gamma.size == phi0.size == phi1.size:
        raise ValueError(f"gamma, phi0, phi1: lengths must be equal, got {gamma.size}, {phi0.size}, {phi1.size}")
    if (gamma < 0).any():
        raise ValueError(f"gamma: must be >= 0, got {gamma.min()}")
    if not -1.0 < poisson <= 0.5:
        raise ValueError(f"poisson: must be in (-1, 0.5], got {poisson}")
    check_count("elements", elements)
    check_count("points", points)
    result = _sim_core.solve_rods(gamma, phi0, phi1, 1.0 / (1.0 + poisson), elements, points)
    return RodSolution(*result)


def finite_array(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> Floats:
    """Return `values` as contiguous float64 of this shape, None standing for any extent."""
    array = np.asarray(values)
    if array.ndim != len(shape) or any(b not in (None, a) for a, b in zip(array.shape, shape, strict=True)):
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
    """Refuse a value that is no integer; the C++ core checks its range."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f"{name}: must be an integer, got {value!r}")
    if not 0 <= value < 2**24:
        raise ValueError(f"{name}: must be in 0 ... 2^24, got {value}")
