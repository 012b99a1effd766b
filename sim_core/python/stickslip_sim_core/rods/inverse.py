"""Inverse design: the natural curvature of a rod with a known hanging shape, and its error."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core import _sim_core
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.rods.solve import (
    CLAMP_FRAME,
    STIFFNESS,
    clamp_quaternions,
    finite_array,
    rod_stiffness,
)
from stickslip_sim_core.rotations import matrices_of_quaternions
from stickslip_sim_core.splines import interpolation_matrix

GRAVITY = np.array([0.0, 0.0, -1.0])

ERROR_MODES = 5
"""Number of polynomials per component, of degree 0 ... 4, in a smooth error of curvature."""


@dataclass(frozen=True, eq=False)
class NaturalCurvature:
    """Natural curvature of rods, with the leading shape (...) of the arguments."""

    curvature: Floats
    """Natural curvature kappa_bar(s) [1/L], shape (..., P, 3).

    Its components are twist, bend about d2 and bend about d3.
    """

    moment: Floats
    """Internal moment m(s) in the material frame [EI/L], shape (..., P, 3).

    It is zero at the free end.
    """

    amplification: Floats
    """Expected relative error of kappa_bar per relative error of kappa [-], shape (...).

    Both errors are root mean squares along the rod. The error of kappa is smooth and random, and
    the frames are integrated from it, too. Multiply the estimated error of your curvature by the
    amplification. The estimate is of first order, and holds while the product is below about 1/2.
    """

    amplification_max: Floats
    """Amplification of the smooth error that harms most, shape (...)."""


def natural_curvature(
    curvature: ArrayLike,
    frame: ArrayLike | None,
    gamma: ArrayLike,
    *,
    stiffness: ArrayLike = STIFFNESS,
    clamp_frame: ArrayLike = CLAMP_FRAME,
) -> NaturalCurvature:
    """Compute the unique natural curvature for which a framed curve hangs in equilibrium.

    Eq. 5.1 of the thesis [Bertails-Descoubes et al. 2018, Sec. 4] integrates m' = m x kappa - gamma
    (1 - s) e_x x g from m(1) = 0, and takes kappa_bar = kappa - K^{-1} m. In world axes the moment
    M = R m needs only a quadrature: M(s) = gamma (int_s^1 (1 - u) t(u) du) x e_g, with e_g along
    gravity. The quadrature goes interval by interval with t, t' and t''. Its error is (kappa h)^6 /
    100800 of the integrand.

    Args:
        curvature: Deformed curvature kappa (twist, bend about d2, bend about d3) [1/L] at P >= 4
            points of uniform arc length, clamp and free end included, shape (..., P, 3).
        frame: Material frames R(s) in the world (z up), columns d1 (tangent), d2, d3, shape (...,
            P, 3, 3). None integrates them from `clamp_frame` by R' = R [kappa]x. They then have the
            error of the curvature.
        gamma: Weight against bending, rho A g L^3 / EI [-], shape (...), >= 0.
        stiffness: K = (GJ, EI_2, EI_3) / EI [-], > 0, shape (3,) or (..., 3).
        clamp_frame: R(0), shape (3, 3) or (..., 3, 3). Only used without `frame`.

    Raises:
        ValueError: An argument breaks its rule. The message names the field, the rule and the
            value.
    """
    shape = np.shape(curvature)
    if len(shape) < 2 or shape[-1] != 3 or shape[-2] < 4:
        raise ValueError(f"curvature: must have shape (..., P, 3) with P >= 4, got shape {shape}")
    leading = shape[:-2]
    points = shape[-2]
    n = int(np.prod(leading))
    kappa = finite_array("curvature", np.reshape(curvature, (n, points, 3)), (n, points, 3))
    if np.shape(gamma) != leading:
        raise ValueError(
            f"gamma: must have the leading shape of curvature {leading}, "
            f"got shape {np.shape(gamma)}"
        )
    weight = finite_array("gamma", np.reshape(gamma, n), (n,))
    if (weight < 0).any():
        raise ValueError(f"gamma: must be >= 0, got {weight.min()}")
    K = rod_stiffness(_flattened(stiffness, leading, 1), n)
    if frame is None:
        R = integrate_frames(kappa, _flattened(clamp_frame, leading, 2))
    else:
        if np.shape(frame) != (*shape, 3):
            raise ValueError(f"frame: must have shape {(*shape, 3)}, got shape {np.shape(frame)}")
        R = finite_array("frame", np.reshape(frame, (n, points, 3, 3)), (n, points, 3, 3))

    world = weight[:, None, None] * np.cross(_weighted_tangent(kappa, R), GRAVITY)
    moment = np.einsum("npji,npj->npi", R, world)
    natural = kappa - moment / K[:, None, :]
    mean, largest = _amplification(kappa, R, world, natural, weight, K)
    return NaturalCurvature(
        natural.reshape(shape),
        moment.reshape(shape),
        mean.reshape(leading),
        largest.reshape(leading),
    )


def integrate_frames(curvature: Floats, clamp_frame: ArrayLike = CLAMP_FRAME) -> Floats:
    """Return the frames (n, P, 3, 3) with R' = R [kappa]x from the clamp on.

    kappa is (n, P, 3) [1/L]. The integration takes two fourth-order Magnus steps per interval, on
    the cubic spline through the curvature [Iserles and Norsett 1999].
    """
    n, points, _ = curvature.shape
    steps = 2 * (points - 1)
    h = 1.0 / steps
    middle = (np.arange(steps) + 0.5) * h
    gauss = np.sqrt(3.0) / 6.0 * h
    a = interpolation_matrix(points, middle - gauss) @ curvature
    b = interpolation_matrix(points, middle + gauss) @ curvature
    # For R' = R [kappa]x: theta = h (a + b) / 2 + sqrt(3)/12 h^2 a x b.
    theta = 0.5 * h * (a + b) + np.sqrt(3.0) / 12.0 * h**2 * np.cross(a, b)
    clamps = clamp_quaternions(clamp_frame, n)
    # A chain whose elements have these turns has the turn over h as its curvature.
    frames = [
        _sim_core.chain_frames(rod / h, clamp)[::2]
        for rod, clamp in zip(theta, clamps, strict=True)
    ]
    quaternions = np.reshape(frames, (-1, 4))
    return matrices_of_quaternions(quaternions).reshape(n, points, 3, 3)


def _flattened(field: ArrayLike, leading: tuple[int, ...], rank: int) -> Floats:
    """Return a field of shape (..., 3[, 3]) with a single leading axis.

    A field that all rods share stays as it is.
    """
    array = np.asarray(field)
    tail = (3,) * rank
    return array.reshape(-1, *tail) if array.shape == (*leading, *tail) else array


def _weighted_tangent(kappa: Floats, R: Floats) -> Floats:
    """Return int_s^1 (1 - u) t du, shape (n, P, 3)."""
    points = kappa.shape[1]
    s = np.linspace(0.0, 1.0, points)
    slope = interpolation_matrix(points, s, derivative=1) @ kappa
    k0, k1, k2 = np.moveaxis(kappa, 2, 0)
    zero = np.zeros_like(k0)
    t = R[..., 0]
    # t' = R (kappa x e_x), t'' = R (kappa x (kappa x e_x) + kappa' x e_x)
    dt = (R @ np.stack([zero, k2, -k1], axis=2)[..., None])[..., 0]
    ddt = np.stack([-(k1**2 + k2**2), k0 * k1 + slope[..., 2], k0 * k2 - slope[..., 1]], axis=2)
    ddt = (R @ ddt[..., None])[..., 0]
    # The integrand and its first two derivatives.
    left = (1.0 - s)[:, None]
    f = left * t
    df = left * dt - t
    ddf = left * ddt - 2.0 * dt
    h = 1.0 / (points - 1)
    parts = (
        h / 2 * (f[:, :-1] + f[:, 1:])
        + h**2 / 10 * (df[:, :-1] - df[:, 1:])
        + h**3 / 120 * (ddf[:, :-1] + ddf[:, 1:])
    )
    # Add the intervals up from the free end, at which the integral is zero.
    sums = np.zeros_like(f)
    sums[:, :-1] = np.cumsum(parts[:, ::-1], axis=1)[:, ::-1]
    return sums


def _amplification(
    kappa: Floats, R: Floats, world: Floats, natural: Floats, gamma: Floats, K: Floats
) -> tuple[Floats, Floats]:
    """Return the expected and the largest error amplification of kappa_bar, shapes (n,).

    Both are relative errors per relative smooth error of kappa.

    An error dk of kappa turns frames by dw = int_0^s R dk (world axes). It follows that dt = dw x
    t, dM = gamma int_s^1 (1 - u) dt x e_g, and d(kappa_bar) = dk - K^{-1} R^T (dM - dw x M).
    """
    points = kappa.shape[1]
    s = np.linspace(0.0, 1.0, points)
    modes = np.polynomial.legendre.legvander(2 * s - 1, ERROR_MODES - 1) * np.sqrt(
        2 * np.arange(ERROR_MODES) + 1
    )
    weights = np.full(points, 1.0 / (points - 1))
    weights[[0, -1]] *= 0.5
    squares = np.empty((len(kappa), 3 * ERROR_MODES, 3 * ERROR_MODES))
    # One rod at a time, because the responses of all rods would need much memory.
    for rod in range(len(kappa)):
        dk = np.einsum("pb,ci->bcpi", modes, np.eye(3)).reshape(-1, points, 3)
        dw = _running_integral(np.einsum("pij,apj->api", R[rod], dk))
        dt = (1.0 - s)[:, None] * np.cross(dw, R[rod, :, :, 0])
        total = _running_integral(dt)
        dM = gamma[rod] * np.cross(total[:, -1:] - total, GRAVITY)
        dm = np.einsum("pji,apj->api", R[rod], dM - np.cross(dw, world[rod]))
        response = dk - dm / K[rod]
        squares[rod] = np.einsum("p,api,bpi->ab", weights, response, response)
    size, natural_size = (np.sqrt(np.einsum("p,npi->n", weights, f**2)) for f in (kappa, natural))
    relative = size / np.maximum(natural_size, 1e-300)
    mean = np.sqrt(np.trace(squares, axis1=1, axis2=2) / (3 * ERROR_MODES))
    largest = (
        np.sqrt(np.maximum(np.linalg.eigvalsh(squares)[:, -1], 0.0))
        if len(squares)
        else np.empty(0)
    )
    return relative * mean, relative * largest


def _running_integral(f: Floats) -> Floats:
    """Return int_0^s f over axis 1 by the trapezoidal rule, which is enough for an estimate."""
    sums = np.zeros_like(f)
    np.cumsum(0.5 * (f[:, :-1] + f[:, 1:]) / (f.shape[1] - 1), axis=1, out=sums[:, 1:])
    return sums
