"""Fits of a hanging rod to a measured centreline.

A fit has three parameters, or natural curvature along the rod.

Both move the natural rod until the *hung* rod, as the forward solver finds it, meets the
centreline. The model is exact in its derivatives: two chains whose nodes include the P points,
extrapolated (4 r_h - r_2h) / 3 with an error O(h^4), each differentiated through its equilibrium
(rods/chain.hpp).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core import _sim_core
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.rods.solve import (
    CLAMP_FRAME,
    ELEMENT_TURN_MAX,
    STIFFNESS,
    RodSolution,
    bspline_matrix,
    clamp_quaternions,
    finite_array,
    interpolation_matrix,
    rod_stiffness,
    solve_general_rods,
)

ELEMENTS_MIN = 96
"""Elements of the coarser chain are at least this many."""

CANDIDATES = 4
"""Rods of the library from which a fit starts."""

RANGES = ((60.0, 2000.0), (0.0, 14.0), (4.0, 22.0))
"""Of gamma, phi0 and phi1 in the library."""

INTERVALS = 24
"""Knot intervals of the splines of natural curvature."""

ITERATIONS_MAX = 40
"""Accepted and refused steps of one minimisation together."""

STEP_TOLERANCE = 1e-7
"""A minimisation ends when a step moves the centreline by less than this [L, root mean square]."""

PATH_TOLERANCE = 1e-5
"""The same on the way through the weights of smoothness; what is chosen is then brought to
STEP_TOLERANCE.
"""

PENALTY_DECADES = np.arange(4.0, -8.5, -0.5)
"""Decadic logarithms of the weights tried, relative to trace(J^T J) / trace(D^T D)."""

DEGREES_FACTOR = 1.4
"""Each degree of freedom counts 1.4 times in cross validation, which then seldom undersmooths [Kim
and Gu 2004].
"""


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
    """Of gamma, phi0, phi1, shape (3,), for white noise as large as the residual; 0 for a given
    gamma.
    """

    residual: float
    """Root mean square distance per coordinate between the hung rod and the centreline [L]."""

    solution: RodSolution
    """The hung rod at the P points, n = 1."""


@dataclass(frozen=True, eq=False)
class NaturalFit:
    """The rod of smoothest natural curvature that hangs along a centreline.

    It follows the centreline as nearly as the noise warrants.
    """

    natural_curvature: Floats
    """(twist, bend about d2, bend about d3) at the P points [1/L], shape (P, 3)."""

    gamma: float
    """Weight against bending [-]: given, or fitted."""

    residual: float
    """Root mean square distance per coordinate between the hung rod and the centreline [L]."""

    noise: float
    """Estimated standard deviation of the centreline's white noise per coordinate [L]."""

    degrees_of_freedom: float
    """Effective number of parameters at the chosen weight of smoothness."""

    smoothness_weight: float
    """The weight that was chosen, relative to trace(J^T J) / trace(D^T D)."""

    solution: RodSolution
    """The hung rod at the P points, n = 1."""


def fit_parameters(
    centerline: ArrayLike, *, gamma: float | None = None, stiffness: ArrayLike = STIFFNESS
) -> ParameterFit:
    """Fit (gamma, phi0, phi1) to a centreline.

    The method is Levenberg's and Marquardt's, from several starts.

    The starts are the nearest of 640 rods over RANGES, hung once per setting and kept; the fit may
    leave the ranges.

    Args: centerline: Positions [L], from the clamp (at the origin) to the free end at uniform arc
        length, z up, shape (P, 3), P >= 8. gamma: Weight against bending if it is known; None:
        fitted. stiffness: K = (GJ, EI_2, EI_3) / EI [-], shape (3,).

    Raises: ValueError: An argument breaks its rule; the message names the field, the rule and the
        value. RuntimeError: None of the rods from which the fit starts hangs in a stable
        equilibrium.
    """
    data = _centerline(centerline)
    model = _Model.of(len(data), stiffness, intervals=None)
    state = _fit_constant(model, data, gamma, components=(0, 2))
    jacobian = model.jacobian(state)[:, [0, 1, 3]]
    used = np.array([gamma is None, True, True])
    variance = (state.residual(data) ** 2).sum() / (data.size - 3 - used.sum())
    error = np.zeros(3)
    error[used] = np.sqrt(
        variance * np.diag(np.linalg.pinv(jacobian[:, used].T @ jacobian[:, used]))
    )
    error[0] *= state.gamma  # from its logarithm's
    phi0, _, phi1 = state.coefficients[0]
    return ParameterFit(
        state.gamma,
        float(phi0),
        float(phi1),
        error,
        _rms(state.residual(data)),
        model.solution(state, len(data)),
    )


def fit_natural_curvature(
    centerline: ArrayLike,
    *,
    gamma: float | None = None,
    noise: float | None = None,
    stiffness: ArrayLike = STIFFNESS,
) -> NaturalFit:
    """Fit natural curvature along the rod to a noisy centreline.

    With c the coefficients of a cubic spline per component, and D their first differences
    [P-splines, Eilers and Marx 1996], Gauss-Newton steps minimise

        |r(c) - centerline|^2 + w |D c|^2.

    The weight w falls from a uniform rod, which is `fit_parameters` with a clamp that may turn
    about its axis. The weight with the least generalised cross validation is chosen [Golub, Heath
    and Wahba 1979]. With `noise`, it is the first weight that brings the residual down to the
    noise, but for one standard deviation of its chi-square [Morozov 1966].

    A centreline does not tell how the frame turns about it: of all that hang along it the smoothest
    natural curvature is returned. What two such rods share, the natural shape, does not depend on
    that choice for a rod that bends equally about d2 and d3.

    Args: centerline: Positions [L], from the clamp (at the origin) to the free end at uniform arc
        length, z up, shape (P, 3), P >= 8. gamma: Weight against bending if it is known; None:
        fitted. noise: Standard deviation of the centreline's noise per coordinate [L], > 0, if it
        is known. Give it when the noise is correlated along the rod: cross validation takes it for
        white. stiffness: As for `fit_parameters`.

    Raises: ValueError: An argument breaks its rule; the message names the field, the rule and the
        value. RuntimeError: None of the rods from which the fit starts hangs in a stable
        equilibrium.
    """
    data = _centerline(centerline)
    if noise is not None and not noise > 0:
        raise ValueError(f"noise: must be > 0, got {noise}")
    constant = _Model.of(len(data), stiffness, intervals=None)
    uniform = _fit_constant(constant, data, gamma, components=(0, 1, 2))
    model = _Model.of(len(data), stiffness, intervals=INTERVALS)
    coefficients = np.tile(uniform.coefficients, (INTERVALS + 3, 1))
    state = model.relax(uniform.gamma, coefficients, uniform.frames)
    assert state is not None  # the same rod as before

    free = np.arange(0 if gamma is None else 1, 1 + 3 * (INTERVALS + 3))
    penalty = np.zeros((1 + 3 * (INTERVALS + 3),) * 2)
    differences = np.diff(np.eye(INTERVALS + 3), axis=0)
    penalty[1:, 1:] = np.kron(np.eye(3), differences.T @ differences)
    jacobian = model.jacobian(state)
    scale = np.trace(jacobian.T @ jacobian) / np.trace(penalty)
    best: tuple[float, _State, float, float] | None = None
    for decade in PENALTY_DECADES:
        weighted = 10.0**decade * scale * penalty
        state = _minimise(model, state, data, free, weighted, PATH_TOLERANCE)
        jacobian = model.jacobian(state)[:, free]
        normal = jacobian.T @ jacobian
        used = float(
            np.trace(
                np.linalg.solve(normal + weighted[np.ix_(free, free)] + _ridge(normal), normal)
            )
        )
        misfit = float((state.residual(data) ** 2).sum())
        left = data.size - 3 - DEGREES_FACTOR * used
        if left <= 0:
            break
        score = misfit / left**2
        degrees_left = data.size - 3 - used
        quiet = noise is not None and misfit <= noise**2 * (
            degrees_left + np.sqrt(2.0 * degrees_left)
        )
        if quiet or best is None or score < best[0]:
            best = (score, state, used, float(decade))
        if quiet or score > 1.5 * best[0]:
            break
    assert best is not None  # the first weight leaves degrees of freedom
    _, state, used, decade = best
    state = _minimise(model, state, data, free, 10.0**decade * scale * penalty, STEP_TOLERANCE)
    misfit = float((state.residual(data) ** 2).sum())
    samples = bspline_matrix(INTERVALS, np.linspace(0.0, 1.0, len(data))) @ state.coefficients
    return NaturalFit(
        samples,
        state.gamma,
        _rms(state.residual(data)),
        float(np.sqrt(misfit / (data.size - 3 - used))),
        used,
        float(10.0**decade),
        model.solution(state, len(data)),
    )


@dataclass(frozen=True, eq=False)
class _State:
    """A hung rod, with its extrapolated centreline (P, 3).

    Spline coefficients are (B, 3); each chain has its frames.
    """

    gamma: float
    coefficients: Floats
    frames: tuple[Floats, ...]
    centerline: Floats

    def residual(self, data: Floats) -> Floats:
        return (self.centerline - data).ravel()


@dataclass(frozen=True, eq=False)
class _Model:
    """From gamma and spline coefficients to the hung centreline at P points."""

    stiffness: Floats
    clamp: Floats  # quaternion
    intervals: int | None  # None: constant
    strides: tuple[int, ...]  # of the chains, in elements per point
    bases: tuple[Floats, ...]  # spline values in the middles of each chain's elements

    @staticmethod
    def of(points: int, stiffness: ArrayLike, intervals: int | None) -> "_Model":
        stride = -(-ELEMENTS_MIN // (points - 1))
        strides = (stride, 2 * stride)
        bases = []
        for k in strides:
            n = k * (points - 1)
            middles = (np.arange(n) + 0.5) / n
            bases.append(
                np.ones((n, 1)) if intervals is None else bspline_matrix(intervals, middles)
            )
        K = rod_stiffness(stiffness, 1)[0]
        clamp = clamp_quaternions(CLAMP_FRAME, 1)[0]
        return _Model(K, clamp, intervals, strides, tuple(bases))

    def relax(
        self, gamma: float, coefficients: Floats, frames: tuple[Floats, ...]
    ) -> _State | None:
        """Hang the rod from `frames` on; None if there is no stable equilibrium nearby."""
        hung = []
        curves = []
        for k, basis, start in zip(self.strides, self.bases, frames, strict=True):
            q, stable = _sim_core.relax_chain(gamma, self.stiffness, basis @ coefficients, start)
            if not stable:
                return None
            hung.append(q)
            curves.append(_sim_core.chain_centerline(q)[::k])
        return _State(gamma, coefficients, tuple(hung), (4.0 * curves[1] - curves[0]) / 3.0)

    def hang(self, gamma: float, coefficients: Floats, curvature: Floats) -> _State | None:
        """Hang the rod from a shape of this curvature, (m, 3) at uniform arc length."""
        frames = []
        for basis in self.bases:
            n = len(basis)
            middles = interpolation_matrix(len(curvature), (np.arange(n) + 0.5) / n) @ curvature
            frames.append(_sim_core.chain_frames(middles, self.clamp))
        return self.relax(gamma, coefficients, tuple(frames))

    def jacobian(self, state: _State) -> Floats:
        """Return derivatives of the centreline by log gamma and the coefficients: (3 P, 1 + 3 B).

        Coefficients are ordered component by component.
        """
        parts = [
            _sim_core.chain_jacobian(
                state.gamma, self.stiffness, basis @ state.coefficients, q, basis, k
            )
            for k, basis, q in zip(self.strides, self.bases, state.frames, strict=True)
        ]
        jacobian = (4.0 * parts[1] - parts[0]) / 3.0
        jacobian[:, 0] *= state.gamma
        return jacobian

    def moved(self, state: _State, step: Floats) -> _State | None:
        """Hang the rod again after a step of (log gamma, coefficients)."""
        if abs(step[0]) > 1.0:  # e-fold: such a step has left where the derivatives mean anything
            return None
        coefficients = state.coefficients + step[1:].reshape(3, -1).T
        return self.relax(state.gamma * float(np.exp(step[0])), coefficients, state.frames)

    def solution(self, state: _State, points: int) -> RodSolution:
        """Solve the fitted rod with the general solver, from the frames of the fit."""
        s = np.linspace(0.0, 1.0, points)
        B = np.ones((points, 1)) if self.intervals is None else bspline_matrix(self.intervals, s)
        natural = B @ state.coefficients
        start = _chain_curvature(state.frames[0])
        largest = max(np.linalg.norm(f, axis=1).max() for f in (natural, start))
        elements = 4 * int(np.ceil(max(largest / (0.8 * ELEMENT_TURN_MAX), 32)))
        return solve_general_rods(
            natural[None],
            [state.gamma],
            stiffness=self.stiffness,
            start_curvature=start[None],
            elements=elements,
            points=points,
        )


def _minimise(
    model: _Model,
    state: _State,
    data: Floats,
    free: NDArray[np.int64],
    penalty: Floats,
    tolerance: float,
) -> _State:
    """Minimise |residual|^2 + c^T penalty c by damped Gauss-Newton steps.

    `free` are the indices of the parameters (log gamma, coefficients) that may change.
    """

    def cost(of: _State) -> float:
        c = _parameters(of)
        return float((of.residual(data) ** 2).sum() + c @ penalty @ c)

    value = cost(state)
    damping = 0.0
    fresh = True
    for _ in range(ITERATIONS_MAX):
        if fresh:
            J = model.jacobian(state)[:, free]
            normal = J.T @ J
            hessian = normal + penalty[np.ix_(free, free)]
            gradient = J.T @ state.residual(data) + (penalty @ _parameters(state))[free]
        diagonal = np.diag(damping * np.diag(normal))
        step = np.zeros(len(penalty))
        step[free] = -np.linalg.solve(hessian + diagonal + _ridge(normal), gradient)
        trial = model.moved(state, step)
        fresh = trial is not None and (trial_value := cost(trial)) <= value
        if fresh:
            assert trial is not None
            change = _rms(trial.centerline - state.centerline)
            state = trial
            value = trial_value
            damping = 0.0 if damping < 1e-4 else 0.1 * damping
            if change <= tolerance:
                break
        else:
            if _rms(J @ step[free]) <= tolerance:
                break  # nothing left but rounding
            damping = max(1e-3, 10.0 * damping)
    return state


def _fit_constant(
    model: _Model, data: Floats, known_gamma: float | None, components: tuple[int, ...]
) -> _State:
    """Fit a uniform rod from the nearest rods of the library."""
    if known_gamma is not None and not (np.isfinite(known_gamma) and known_gamma > 0):
        raise ValueError(f"gamma: must be > 0, got {known_gamma}")
    gammas, natural, centerlines, curvature = _library(
        len(data), tuple(model.stiffness), known_gamma
    )
    distance = np.linalg.norm(centerlines - data, axis=(1, 2))
    free = np.array([0] * (known_gamma is None) + [1 + c for c in components])
    best: _State | None = None
    for i in np.argsort(distance)[:CANDIDATES]:
        state = model.hang(float(gammas[i]), natural[i][None], curvature[i])
        if state is None:
            continue
        state = _minimise(model, state, data, free, np.zeros((4, 4)), STEP_TOLERANCE)
        if best is None or _rms(state.residual(data)) < _rms(best.residual(data)):
            best = state
    if best is None:
        raise RuntimeError("no rod near the centreline hangs in a stable equilibrium")
    return best


@lru_cache(maxsize=8)
def _library(
    points: int, stiffness: tuple[float, ...], known_gamma: float | None
) -> tuple[Floats, ...]:
    """Hang rods over RANGES of gamma, phi0, phi1: 10 x 8 x 8, or 1 x 16 x 16 where gamma is known.

    Returns gamma (n,), natural curvature (n, 3), and centreline and curvature (n, P, 3) of the
    stable ones.
    """
    per_axis = 8 if known_gamma is None else 16
    axes = (
        np.geomspace(*RANGES[0], 10) if known_gamma is None else np.array([float(known_gamma)]),
        np.linspace(*RANGES[1], per_axis),
        np.linspace(*RANGES[2], per_axis),
    )
    gamma, phi0, phi1 = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    natural = np.stack([phi0, 0.0 * phi0, phi1], axis=1)
    rods = solve_general_rods(
        natural[:, None], gamma, stiffness=stiffness, elements=96, points=points
    )
    good = rods.stable
    return gamma[good], natural[good], rods.centerline[good], rods.curvature[good]


def _centerline(centerline: ArrayLike) -> Floats:
    data = finite_array("centerline", centerline, (None, 3))
    if len(data) < 8:
        raise ValueError(f"centerline: must have at least 8 points, got {len(data)}")
    return data


def _chain_curvature(quaternions: Floats) -> Floats:
    """Return the curvature of a chain at its nodes, shape (N + 1, 3).

    It averages the curvatures of the elements, and repeats those at the ends.
    """
    p = quaternions[:-1]
    q = quaternions[1:]
    w = (p * q).sum(axis=1)
    v = p[:, :1] * q[:, 1:] - q[:, :1] * p[:, 1:] - np.cross(p[:, 1:], q[:, 1:])
    sine = np.linalg.norm(v, axis=1)
    kappa = (
        2.0
        * len(p)
        * np.where(sine > 1e-8, np.arctan2(sine, w) / np.maximum(sine, 1e-8), 1.0)[:, None]
        * v
    )
    return np.concatenate([kappa[:1], 0.5 * (kappa[1:] + kappa[:-1]), kappa[-1:]])


def _parameters(state: _State) -> Floats:
    return np.concatenate([[np.log(state.gamma)], state.coefficients.T.ravel()])


def _ridge(normal: Floats) -> Floats:
    """Keep rounding from making a normal matrix singular."""
    return np.asarray(1e-13 * np.trace(normal) * np.eye(len(normal)))


def _rms(f: Floats) -> float:
    return float(np.sqrt((f**2).mean()))
