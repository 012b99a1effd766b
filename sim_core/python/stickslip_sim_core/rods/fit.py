"""Fits of a hanging rod to a measured centreline.

A fit determines three parameters, or natural curvature along the rod. Both fits move the natural
rod until the *hung* rod of the forward model (`hung_rod`) meets the centreline.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.rods.clamp import refuse_other_clamp
from stickslip_sim_core.rods.hung_rod import (
    HungRod,
    HungRodModel,
    minimise,
    ridge,
    root_mean_square,
)
from stickslip_sim_core.rods.solve import (
    CLAMP_FRAME,
    STIFFNESS,
    Bools,
    RodSolution,
    finite_array,
    solve_general_rods,
)
from stickslip_sim_core.splines import bspline_matrix

CANDIDATES = 4
"""Number of rods of the library from which a fit starts."""

MAX_CANDIDATES = 32
"""Number of rods from which a fit starts that has not come down to the noise before."""

NOISE_FACTOR = 1.2
"""A residual of up to this many times the estimated noise is down to it. The estimate from 100
points is off by 5 %, that from 8 points by a third, which costs more starts and no accuracy.
"""


@dataclass(frozen=True)
class LibraryRanges:
    """Ranges of the rods from which fits start."""

    gamma: tuple[float, float]
    phi0: tuple[float, float]
    phi1: tuple[float, float]


HANGING_RANGES = LibraryRanges((60.0, 2000.0), (0.0, 14.0), (4.0, 22.0))
"""For a clamp along gravity. A rod without natural bend hangs straight, so it has no fit. A bend to
the other side is the same rod, turned by half a turn about the vertical.
"""

LEANING_RANGES = LibraryRanges((5.0, 4000.0), (0.0, 14.0), (-22.0, 22.0))
"""For any other clamp. A straight rod sags, and a bend up and a bend down are different rods."""

VERTICAL_COSINE = 0.999
"""A clamp is along gravity if the cosine between its d1 and gravity is at least this: 2.6 degrees,
less than anybody sets a clamp by eye.
"""

INTERVALS = 24
"""Number of knot intervals in the splines of natural curvature."""

STEP_TOLERANCE = 1e-7
"""A minimisation ends when a step moves the centreline by less than this [L, root mean square]."""

PATH_TOLERANCE = 1e-5
"""Tolerance of the same kind for the search through the weights of smoothness.

The chosen fit then goes on to STEP_TOLERANCE.
"""

PENALTY_DECADES = np.arange(4.0, -8.5, -0.5)
"""Decadic logarithms of the weights to try, relative to trace(J^T J) / trace(D^T D)."""

DEGREES_FACTOR = 1.4
"""Factor of the degrees of freedom in cross validation.

With it, cross validation seldom undersmooths [Kim and Gu 2004].
"""


COUPLED_CORRELATION = 0.9
"""From this correlation on, a bend makes up for a weight: four fifths of the variance of gamma are
that of the bend.
"""

UNCERTAIN_GAMMA = 0.1
"""Relative standard error of gamma from which on a coupled fit does not determine it."""


@dataclass(frozen=True, eq=False)
class ParameterFit:
    """The uniform rod (gamma, phi0, phi1) that hangs nearest to a centreline."""

    gamma: float
    """Weight against bending [-]."""

    phi0: float
    """Natural twist times L [rad]."""

    phi1: float
    """Natural bend about d3 times L [rad]."""

    standard_error: Floats
    """Standard errors of gamma, phi0 and phi1, for white noise as large as the residual: (3,).

    The error of a given gamma is 0.
    """

    correlation: Floats
    """Correlations of the errors of log gamma, phi0 and phi1, (3, 3); NaN for given ones."""

    residual: float
    """Root mean square distance per coordinate between the hung rod and the centreline [L]."""

    solution: RodSolution
    """The hung rod at the P points, n = 1."""

    @property
    def trades_bend_for_weight(self) -> bool:
        """Whether the centreline cannot tell a stiffer rod from one with another natural bend.

        Then a small residual says nothing about gamma: measure the weight, or a longer rod.
        """
        relative_error = self.standard_error[0] / self.gamma
        is_coupled = abs(self.correlation[0, 2]) > COUPLED_CORRELATION
        return bool(is_coupled and relative_error > UNCERTAIN_GAMMA)


@dataclass(frozen=True, eq=False)
class NaturalFit:
    """The rod of smoothest natural curvature that hangs along a centreline.

    The rod follows the centreline as closely as the noise warrants.
    """

    natural_curvature: Floats
    """(twist, bend about d2, bend about d3) at the P points [1/L], shape (P, 3)."""

    gamma: float
    """Weight against bending [-], given or fitted."""

    residual: float
    """Root mean square distance per coordinate between the hung rod and the centreline [L]."""

    noise: float
    """Estimated standard deviation of the centreline's white noise per coordinate [L]."""

    degrees_of_freedom: float
    """Effective number of parameters at the chosen weight of smoothness."""

    smoothness_weight: float
    """Chosen weight of smoothness, relative to trace(J^T J) / trace(D^T D)."""

    solution: RodSolution
    """The hung rod at the P points, n = 1."""


def fit_parameters(
    centerline: ArrayLike,
    *,
    gamma: float | None = None,
    phi0: float | None = None,
    stiffness: ArrayLike = STIFFNESS,
    clamp_frame: ArrayLike = CLAMP_FRAME,
) -> ParameterFit:
    """Fit (gamma, phi0, phi1) to a centreline.

    The method is Levenberg's and Marquardt's, from several starts. The starts are the rods nearest
    to the centreline in a library over RANGES. The library has 640 rods without a known gamma, is
    made once per setting, and stays in memory. The fit may leave the ranges.

    Args:
        centerline: Positions [L] from the clamp (at the origin) to the free end, at uniform arc
            length, z up, shape (P, 3), P >= 8.
        gamma: Weight against bending, if it is known. None fits it.
        phi0: Natural twist times L [rad], if it is known. None fits it. A centreline in a plane
            does not determine the twist: give 0 for a rod in one photograph.
        stiffness: K = (GJ, EI_2, EI_3) / EI [-], shape (3,).
        clamp_frame: R(0), columns d1 (tangent), d2, d3 in the world (z up), shape (3, 3). phi1 is
            the bend about d3. For a rod over the edge of a table in the plane of x and z, give
            [[1, 0, 0], [0, 0, -1], [0, 1, 0]].

    Raises:
        ValueError: An argument breaks its rule, or the centreline leaves the clamp in another
            direction. The message names the field, the rule and the value.
        RuntimeError: None of the rods from which the fit starts hangs in a stable equilibrium.
    """
    data = _centerline(centerline)
    _refuse_bad_gamma(gamma)
    if phi0 is not None and not np.isfinite(phi0):
        raise ValueError(f"phi0: must be finite, got {phi0}")
    model = HungRodModel.of(len(data), stiffness, None, clamp_frame)
    refuse_other_clamp(data, model.clamp_frame)
    bends = (2,) if phi0 is not None else (0, 2)
    state = _fit_constant(model, data, gamma, phi0, components=bends)

    is_fitted = np.array([gamma is None, phi0 is None, True])
    jacobian = model.jacobian(state)[:, [0, 1, 3]]
    error, correlation = _errors(jacobian, state.residual(data), is_fitted)
    # From the error of log gamma to the error of gamma.
    error[0] *= state.gamma
    fitted_phi0, _, fitted_phi1 = state.coefficients[0]
    return ParameterFit(
        state.gamma,
        float(fitted_phi0),
        float(fitted_phi1),
        error,
        correlation,
        root_mean_square(state.residual(data)),
        model.solution(state, len(data)),
    )


def _errors(jacobian: Floats, residual: Floats, is_fitted: Bools) -> tuple[Floats, Floats]:
    """Return standard errors (3,) and correlations (3, 3) of log gamma, phi0 and phi1.

    They follow from the curvature of the squared error. The clamped point has no error, so its
    three coordinates are no data.
    """
    variance = (residual**2).sum() / (residual.size - 3 - is_fitted.sum())
    fitted = jacobian[:, is_fitted]
    covariance = variance * np.linalg.pinv(fitted.T @ fitted)
    deviation = np.sqrt(np.diag(covariance))
    error = np.zeros(3)
    error[is_fitted] = deviation
    correlation = np.full((3, 3), np.nan)
    scale = np.maximum(np.outer(deviation, deviation), np.finfo(float).tiny)
    correlation[np.ix_(is_fitted, is_fitted)] = covariance / scale
    return error, correlation


def fit_natural_curvature(
    centerline: ArrayLike,
    *,
    gamma: float | None = None,
    noise: float | None = None,
    stiffness: ArrayLike = STIFFNESS,
    clamp_frame: ArrayLike = CLAMP_FRAME,
) -> NaturalFit:
    """Fit natural curvature along the rod to a noisy centreline.

    Each component is a cubic spline with coefficients c and their first differences D c [P-splines,
    Eilers and Marx 1996]. Gauss-Newton steps minimise

        |r(c) - centerline|^2 + w |D c|^2.

    The weight w falls. Its large limit is a uniform rod, which is `fit_parameters` with a clamp
    that may turn about its axis. The fit chooses the weight with the least generalised cross
    validation [Golub, Heath and Wahba 1979]. With `noise`, it chooses the first weight that brings
    the residual down to the noise, plus one standard deviation of its chi-square [Morozov 1966].

    A centreline does not determine how the frame turns about it. Of all natural curvatures that
    hang along the centreline, the fit returns the smoothest. For a rod that bends equally about d2
    and d3, all of them have the same natural shape.

    Args:
        centerline: Positions [L] from the clamp (at the origin) to the free end, at uniform arc
            length, z up, shape (P, 3), P >= 8.
        gamma: Weight against bending, if it is known. None fits it.
        noise: Standard deviation of the centreline's noise per coordinate [L], > 0, if it is known.
            Give it if the noise is correlated along the rod, because cross validation assumes white
            noise.
        stiffness: As for `fit_parameters`.
        clamp_frame: As for `fit_parameters`.

    Raises:
        ValueError: An argument breaks its rule, or the centreline leaves the clamp in another
            direction. The message names the field, the rule and the value.
        RuntimeError: None of the rods from which the fit starts hangs in a stable equilibrium.
    """
    data = _centerline(centerline)
    _refuse_bad_gamma(gamma)
    if noise is not None and not noise > 0:
        raise ValueError(f"noise: must be > 0, got {noise}")

    # The path begins with a uniform rod, the limit of a large weight of smoothness.
    constant = HungRodModel.of(len(data), stiffness, None, clamp_frame)
    refuse_other_clamp(data, constant.clamp_frame)
    uniform = _fit_constant(constant, data, gamma, None, components=(0, 1, 2))
    model = HungRodModel.of(len(data), stiffness, INTERVALS, clamp_frame)
    coefficients = np.tile(uniform.coefficients, (INTERVALS + 3, 1))
    start = model.relax(uniform.gamma, coefficients, uniform.frames)
    assert start is not None  # the same rod as before

    problem = _SmoothFit.of(model, data, start, is_gamma_fitted=gamma is None)
    best = _search_weights(problem, start, noise)
    # Bring the chosen fit down to the tolerance of a result.
    state = problem.minimise(best.state, best.decade, STEP_TOLERANCE)
    samples = bspline_matrix(INTERVALS, np.linspace(0.0, 1.0, len(data))) @ state.coefficients
    return NaturalFit(
        samples,
        state.gamma,
        root_mean_square(state.residual(data)),
        float(np.sqrt(problem.misfit(state) / (problem.data_count - best.degrees_used))),
        best.degrees_used,
        float(10.0**best.decade),
        model.solution(state, len(data)),
    )


@dataclass(frozen=True, eq=False)
class _SmoothFit:
    """The least squares of `fit_natural_curvature`, for any weight of smoothness."""

    model: HungRodModel
    data: Floats
    free: NDArray[np.int_]
    """Numbers of the fitted parameters: log gamma, if it is fitted, and all coefficients."""

    penalty: Floats
    """Matrix of |D c|^2."""

    scale: float
    """Weight of smoothness that weighs as much as the data."""

    @classmethod
    def of(
        cls, model: HungRodModel, data: Floats, start: HungRod, *, is_gamma_fitted: bool
    ) -> Self:
        """Scale the weight of smoothness by the derivatives at a start."""
        size = 1 + 3 * (INTERVALS + 3)
        penalty = np.zeros((size, size))
        differences = np.diff(np.eye(INTERVALS + 3), axis=0)
        penalty[1:, 1:] = np.kron(np.eye(3), differences.T @ differences)
        jacobian = model.jacobian(start)
        scale = np.trace(jacobian.T @ jacobian) / np.trace(penalty)
        free = np.arange(0 if is_gamma_fitted else 1, size)
        return cls(model, data, free, penalty, float(scale))

    @property
    def data_count(self) -> int:
        """Number of coordinates; the clamped point has no error, so its three are no data."""
        return self.data.size - 3

    def weighted_penalty(self, decade: float) -> Floats:
        """Return the matrix of w |D c|^2, with w in decades."""
        return np.asarray(10.0**decade * self.scale * self.penalty)

    def minimise(self, state: HungRod, decade: float, tolerance: float) -> HungRod:
        """Return the minimum for a weight, from a state nearby."""
        weighted = self.weighted_penalty(decade)
        return minimise(self.model, state, self.data, self.free, weighted, tolerance)

    def misfit(self, state: HungRod) -> float:
        """Return the sum of squared residuals [L^2]."""
        return float((state.residual(self.data) ** 2).sum())

    def degrees_used(self, state: HungRod, decade: float) -> float:
        """Return the trace of the matrix that maps data to the fit."""
        jacobian = self.model.jacobian(state)[:, self.free]
        normal = jacobian.T @ jacobian
        penalty = self.weighted_penalty(decade)[np.ix_(self.free, self.free)]
        return float(np.trace(np.linalg.solve(normal + penalty + ridge(normal), normal)))


class _WeightedFit(NamedTuple):
    """The fit for one weight of smoothness."""

    score: float
    """Generalised cross validation; the least is the best."""

    state: HungRod
    degrees_used: float
    decade: float


def _search_weights(problem: _SmoothFit, start: HungRod, noise: float | None) -> _WeightedFit:
    """Return the fit for the best weight of smoothness, or for the first at the noise."""
    best: _WeightedFit | None = None
    state = start
    # The fit of each weight begins at the fit of the last weight, which is near.
    for decade in PENALTY_DECADES:
        state = problem.minimise(state, decade, PATH_TOLERANCE)
        used = problem.degrees_used(state, decade)
        misfit = problem.misfit(state)
        effective_size = problem.data_count - DEGREES_FACTOR * used
        if effective_size <= 0:
            break
        fit = _WeightedFit(misfit / effective_size**2, state, used, float(decade))

        # With the residual down at the noise, a smaller weight would fit the noise itself.
        degrees_left = problem.data_count - used
        is_at_noise = noise is not None and misfit <= noise**2 * (
            degrees_left + np.sqrt(2.0 * degrees_left)
        )
        if is_at_noise or best is None or fit.score < best.score:
            best = fit

        # Stop well past the least score, since small rises may come before it.
        if is_at_noise or fit.score > 1.5 * best.score:
            break
    assert best is not None  # the first weight leaves degrees of freedom
    return best


def _fit_constant(
    model: HungRodModel,
    data: Floats,
    known_gamma: float | None,
    known_phi0: float | None,
    components: tuple[int, ...],
) -> HungRod:
    """Fit a uniform rod from the nearest rods of the library."""
    gammas, natural, centerlines, curvature = _library(
        len(data), tuple(model.stiffness), known_gamma, known_phi0, tuple(model.clamp_frame.ravel())
    )

    # The squared error has several minima, so start from the rods that hang nearest.
    distance = np.linalg.norm(centerlines - data, axis=(1, 2))
    free = np.array([0] * (known_gamma is None) + [1 + c for c in components])
    best: HungRod | None = None
    target = NOISE_FACTOR * _noise_of(data)
    for rank, i in enumerate(np.argsort(distance)[:MAX_CANDIDATES]):
        if rank >= CANDIDATES and best and root_mean_square(best.residual(data)) <= target:
            break
        state = model.hang(float(gammas[i]), natural[i][None], curvature[i])
        if state is None:
            continue
        state = minimise(model, state, data, free, np.zeros((4, 4)), STEP_TOLERANCE)
        if best is None or root_mean_square(state.residual(data)) < root_mean_square(
            best.residual(data)
        ):
            best = state
    if best is None:
        raise RuntimeError("no rod near the centreline hangs in a stable equilibrium")
    return best


def _noise_of(data: Floats) -> float:
    """Estimate the standard deviation of the white noise of a centreline (P, 3) per coordinate [L].

    The fourth difference of white noise has 1 + 16 + 36 + 16 + 1 = 70 times its variance. That of a
    smooth curve is of the order of the fourth power of the distance of points.
    """
    return root_mean_square(np.diff(data, n=4, axis=0)) / float(np.sqrt(70.0))


@lru_cache(maxsize=8)
def _library(
    points: int,
    stiffness: tuple[float, ...],
    known_gamma: float | None,
    known_phi0: float | None,
    clamp: tuple[float, ...],
) -> tuple[Floats, ...]:
    """Hang rods over the ranges of gamma, phi0 and phi1.

    Without known parameters there are 10 x 8 x 8 rods, with a known gamma 1 x 16 x 16. For a clamp
    that is not along gravity, phi1 has both signs, and the straight rod in the middle.

    Returns gamma (n,), natural curvature (n, 3), and centreline and curvature (n, P, 3) of the
    stable rods.
    """
    clamp_frame = np.reshape(clamp, (3, 3))
    is_along_gravity = -clamp_frame[2, 0] >= VERTICAL_COSINE
    ranges = HANGING_RANGES if is_along_gravity else LEANING_RANGES
    per_axis = 8 if known_gamma is None else 16
    bends = per_axis if is_along_gravity else 2 * per_axis + 1
    axes = (
        np.geomspace(*ranges.gamma, 10) if known_gamma is None else np.array([float(known_gamma)]),
        np.linspace(*ranges.phi0, per_axis)
        if known_phi0 is None
        else np.array([float(known_phi0)]),
        np.linspace(*ranges.phi1, bends),
    )
    gamma, phi0, phi1 = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    natural = np.stack([phi0, 0.0 * phi0, phi1], axis=1)
    rods = solve_general_rods(
        natural[:, None],
        gamma,
        stiffness=stiffness,
        clamp_frame=clamp_frame,
        elements=96,
        points=points,
    )
    good = rods.stable
    return gamma[good], natural[good], rods.centerline[good], rods.curvature[good]


def _refuse_bad_gamma(gamma: float | None) -> None:
    if gamma is not None and not (np.isfinite(gamma) and gamma > 0):
        raise ValueError(f"gamma: must be > 0, got {gamma}")


def _centerline(centerline: ArrayLike) -> Floats:
    data = finite_array("centerline", centerline, (None, 3))
    if len(data) < 8:
        raise ValueError(f"centerline: must have at least 8 points, got {len(data)}")
    return data
