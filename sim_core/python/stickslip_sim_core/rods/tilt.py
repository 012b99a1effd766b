"""A fit of a rod together with the tilt of its clamp, for clamps that nobody has measured."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.rods.clamp import MAX_ANGLE
from stickslip_sim_core.rods.fit import (
    STEP_TOLERANCE,
    VERTICAL_COSINE,
    ParameterFit,
    fit_parameters,
)
from stickslip_sim_core.rods.hung_rod import HungRod, HungRodModel, minimise, root_mean_square
from stickslip_sim_core.rods.solve import CLAMP_FRAME, STIFFNESS, finite_array

TILT_STEP = np.radians(5.0)
"""Distance of the tilts that are tried first [rad]; the best one is refined."""

TILT_TOLERANCE = 1e-4
"""Accuracy of the refined tilt [rad]."""

DERIVATIVE_STEP = 1e-3
"""Change of the tilt for derivatives of the centreline [rad]."""


@dataclass(frozen=True, eq=False)
class TiltedFit:
    """A uniform rod and the tilt of its clamp."""

    rod: ParameterFit
    """The rod. Its standard errors leave the uncertainty of the tilt in: they are larger."""

    tilt: float
    """Angle by which d1 of the clamp is turned up, in the vertical plane through it [rad]."""

    tilt_error: float
    """Standard error of the tilt, for white noise as large as the residual [rad]."""

    clamp_frame: Floats
    """The tilted clamp, (3, 3)."""


def fit_tilted_clamp(
    centerline: ArrayLike,
    *,
    gamma: float | None = None,
    phi0: float | None = None,
    stiffness: ArrayLike = STIFFNESS,
    clamp_frame: ArrayLike = CLAMP_FRAME,
) -> TiltedFit:
    """Fit (gamma, phi0, phi1) and a tilt of the clamp to a centreline.

    The tilt is a fourth parameter, up to 45 degrees to both sides. It costs accuracy: give the
    clamp as you measured it, and use `fit_parameters`, wherever you have measured it.

    Args:
        centerline: As for `fit_parameters`.
        gamma: As for `fit_parameters`.
        phi0: As for `fit_parameters`.
        stiffness: As for `fit_parameters`.
        clamp_frame: The clamp without its tilt, as for `fit_parameters`.

    Raises:
        ValueError: As for `fit_parameters`, or the clamp is along gravity, where a tilt has no
            plane.
        RuntimeError: As for `fit_parameters`.
    """
    frame = finite_array("clamp_frame", clamp_frame, (3, 3))
    if abs(frame[2, 0]) >= VERTICAL_COSINE:
        raise ValueError(
            "clamp_frame: must not be along gravity, where a tilt has no plane, and d1 is "
            f"{frame[:, 0].tolist()}"
        )
    untilted = fit_parameters(
        centerline, gamma=gamma, phi0=phi0, stiffness=stiffness, clamp_frame=frame
    )
    data = np.asarray(centerline, float)
    fitted = np.array([gamma is None, phi0 is None, False, True])
    search = _Search(data, frame, stiffness, np.flatnonzero(fitted), untilted)
    tilt, state = search.run()
    return _tilted_fit(search, tilt, state)


class _Search:
    """Rods that hang nearest to a centreline, by the tilt of their clamp."""

    def __init__(
        self,
        data: Floats,
        frame: Floats,
        stiffness: ArrayLike,
        free: NDArray[np.int64],
        untilted: ParameterFit,
    ) -> None:
        self.data = data
        self.frame = frame
        self.stiffness = stiffness
        self.free = free
        self.untilted = untilted

    def model(self, tilt: float) -> HungRodModel:
        """Return the forward model of a tilted clamp."""
        return HungRodModel.of(len(self.data), self.stiffness, None, tilted_frame(self.frame, tilt))

    def rod(self, tilt: float, start: HungRod | None) -> HungRod | None:
        """Return the nearest rod for a tilt, from a rod of another tilt; None if none hangs."""
        model = self.model(tilt)
        if start is None:
            natural = np.array([[self.untilted.phi0, 0.0, self.untilted.phi1]])
            gamma = self.untilted.gamma
        else:
            natural = start.coefficients
            gamma = start.gamma
        state = model.hang(gamma, natural, self.untilted.solution.curvature[0])
        if state is None:
            return None
        return minimise(model, state, self.data, self.free, np.zeros((4, 4)), STEP_TOLERANCE)

    def cost(self, tilt: float, start: HungRod | None) -> float:
        """Return the residual of the nearest rod [L], infinite where none hangs."""
        state = self.rod(tilt, start)
        return np.inf if state is None else root_mean_square(state.residual(self.data))

    def run(self) -> tuple[float, HungRod]:
        """Return the tilt of the least residual, and its rod."""
        # From no tilt outwards to both sides: each rod starts from its neighbour.
        best_tilt = 0.0
        best = self.rod(0.0, None)
        least = np.inf if best is None else root_mean_square(best.residual(self.data))
        steps = int(MAX_ANGLE / TILT_STEP)
        for side in (1.0, -1.0):
            state = self.rod(0.0, None)
            for step in range(1, steps + 1):
                tilt = side * step * TILT_STEP
                state = self.rod(tilt, state)
                residual = np.inf if state is None else root_mean_square(state.residual(self.data))
                if residual < least:
                    best_tilt = tilt
                    best = state
                    least = residual
        if best is None:
            raise RuntimeError("no rod near the centreline hangs in a stable equilibrium")
        # The minimum is within a step of the best tilt.
        tilt = _place_of_minimum(
            lambda angle: self.cost(angle, best), best_tilt - TILT_STEP, best_tilt + TILT_STEP
        )
        state = self.rod(tilt, best)
        if state is None or root_mean_square(state.residual(self.data)) > least:
            return best_tilt, best
        return tilt, state


def _place_of_minimum(cost: Callable[[float], float], low: float, high: float) -> float:
    """Return where a function is least between two places, to `TILT_TOLERANCE` [Kiefer 1953].

    Golden section search: one of two inner places is used again in the next interval.
    """
    ratio = 0.5 * (np.sqrt(5.0) - 1.0)
    inner = [high - ratio * (high - low), low + ratio * (high - low)]
    costs = [cost(inner[0]), cost(inner[1])]
    while high - low > TILT_TOLERANCE:
        if costs[0] < costs[1]:
            high = inner[1]
            inner = [high - ratio * (high - low), inner[0]]
            costs = [cost(inner[0]), costs[0]]
        else:
            low = inner[0]
            inner = [inner[1], low + ratio * (high - low)]
            costs = [costs[1], cost(inner[1])]
    return float(0.5 * (low + high))


def _tilted_fit(search: _Search, tilt: float, state: HungRod) -> TiltedFit:
    """Return the fit of a tilt and its rod, with errors of all fitted parameters together."""
    model = search.model(tilt)
    residual = state.residual(search.data)
    columns = [model.jacobian(state)[:, search.free], _by_tilt(search, tilt, state)]
    jacobian = np.concatenate(columns, axis=1)
    # The clamped point has no error, so its three coordinates are no data.
    variance = (residual**2).sum() / (residual.size - 3 - jacobian.shape[1])
    covariance = variance * np.linalg.pinv(jacobian.T @ jacobian)
    deviation = np.sqrt(np.diag(covariance))

    # Of log gamma, phi0, bend about d2 (never fitted) and phi1.
    error = np.zeros(4)
    error[search.free] = deviation[:-1]
    correlation = np.full((4, 4), np.nan)
    scale = np.maximum(np.outer(deviation, deviation), np.finfo(float).tiny)
    correlation[np.ix_(search.free, search.free)] = (covariance / scale)[:-1, :-1]
    named = [0, 1, 3]
    phi0, _, phi1 = (float(value) for value in state.coefficients[0])
    rod = replace(
        search.untilted,
        gamma=state.gamma,
        phi0=phi0,
        phi1=phi1,
        standard_error=error[named] * np.array([state.gamma, 1.0, 1.0]),
        correlation=correlation[np.ix_(named, named)],
        residual=root_mean_square(residual),
        solution=model.solution(state, len(search.data)),
    )
    return TiltedFit(rod, tilt, float(deviation[-1]), model.clamp_frame)


def _by_tilt(search: _Search, tilt: float, state: HungRod) -> Floats:
    """Return the derivative of the centreline by the tilt, for the same rod: (3 P, 1)."""
    curvature = search.model(tilt).solution(state, len(search.data)).curvature[0]
    ends = []
    for side in (1.0, -1.0):
        moved = search.model(tilt + side * DERIVATIVE_STEP).hang(
            state.gamma, state.coefficients, curvature
        )
        # A rod at the edge of its stability has a derivative to one side only.
        ends.append((state if moved is None else moved).centerline.ravel())
    return np.asarray((ends[0] - ends[1]) / (2.0 * DERIVATIVE_STEP))[:, None]


def tilted_frame(frame: Floats, tilt: float) -> Floats:
    """Return a clamp (3, 3) whose d1 is turned up by an angle [rad] in its vertical plane.

    R = I + sin(t) A + (1 - cos(t)) A^2, with A v = a x v and the horizontal axis a = d1 x z.
    """
    axis = np.cross(frame[:, 0], [0.0, 0.0, 1.0])
    axis /= np.linalg.norm(axis)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation = np.eye(3) + np.sin(tilt) * cross + (1.0 - np.cos(tilt)) * cross @ cross
    return np.asarray(rotation @ frame)
