"""Master curve of a curly rod: the weight below which it leaves its plane."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.reference.boundary_values import (
    NotSolvedError,
    positive,
    solve_boundary_values,
    within,
)


def bend_twist(phi: ArrayLike, poisson: float) -> Floats:
    """Return the weight Gamma above which a curly rod hangs in a plane.

    Below it the rod turns three-dimensional.

    The rod has natural curvature phi / L about d3 and no natural twist. Its stiffness is GJ/EI = C
    = 1/(1 + poisson), and it is clamped with its tangent along gravity. The boundary is the Gamma
    at which the planar equilibrium, followed from large Gamma downwards, ceases to be a strict
    minimum over all rotations. The result is NaN for phi below `bend_twist_onset`, because the
    planar equilibrium is then stable for every weight.

    Let Lambda = Gamma^{1/3}, k = phi / Lambda, and sigma = (1 - s) Lambda from the free end, with a
    dot for d/dsigma. The planar rod [theta: angle from gravity to tangent; q: moment about d3] is

        theta. = -(k + q),   q. = -sigma sin theta,   q(0) = 0,   theta(Lambda) = 0.

    Its linearised Kirchhoff equations out of the plane [mu0, mu1: moments about d1, d2; eta: slope
    of the tangent] are

        mu0. = -k mu1,   mu1. = (k + q) mu0 - q mu0 / C - sigma eta,
        eta. = -cos(theta) mu1 - sin(theta) mu0 / C

    from mu0 = mu1 = 0, eta = 1 at the free end. The rotation about gravity is the other solution,
    so the determinant of Jacobi's fields is eta. The planar rod is a minimum while eta has no zero.
    On the boundary the first zero, coming from infinity, is at the clamp: eta(Lambda) = 0.

    Args:
        phi: Natural curvature times L [rad], > 0, any shape.
        poisson: Poisson's ratio [-], in [0, 0.5].

    Raises:
        ValueError: An argument breaks its rule.
    """
    values = positive("phi", phi)
    curve = _boundary(poisson)
    return np.array([curve.gamma_at(float(v)) for v in values.ravel()]).reshape(values.shape)


def bend_twist_onset(poisson: float) -> tuple[float, float]:
    """Return (phi, Gamma) of the least natural curvature that makes the rod three-dimensional."""
    onset = _boundary(poisson).onset
    return onset.phi, onset.Lambda**3


@dataclass(frozen=True, eq=False)
class _BoundaryPoint:
    """A planar rod on the Bend-Twist boundary."""

    Lambda: float
    """Cube root of the weight Gamma."""

    phi: float
    fields: Callable[[Floats], Floats]
    """(theta, q, mu0, mu1, eta) over sigma / Lambda."""


class _Boundary:
    """The boundary curve of a Poisson's ratio, (Lambda, phi(Lambda)).

    The curve starts from an anchor and follows a ladder of values of Lambda. Every climb starts at
    the anchor, so no point depends on earlier calls.
    """

    # Ratio of neighbours on the ladder above the anchor.
    UP = 1.1
    # Ratio of neighbours below the anchor. Rods differ more there.
    DOWN = 0.97
    TOLERANCE = 1e-12  # relative, on Lambda
    # From this phi on rods are alike: their fields fall as exp(-(2/3) sigma^1.5), to 1e-30 at the
    # clamp.
    LONG = 40.0

    def __init__(self, poisson: float) -> None:
        self.C = 1.0 / (1.0 + poisson)
        self._up = [self._anchor()]
        self._down = [self._up[0]]

    @cached_property
    def onset(self) -> _BoundaryPoint:
        """The point of least phi, by parabolas through three points ever closer."""
        # Go down the ladder to the least phi. Then fit parabolas, each through closer points.
        rung = 0
        while self._rung(-rung - 1).phi < self._rung(-rung).phi:
            rung += 1
        best = self._rung(-rung)
        for spread in (0.02, 0.003, 0.0005):
            below, above = (
                self._solve(best.Lambda * (1.0 + side * spread), best) for side in (-1.0, 1.0)
            )
            slope = above.phi - below.phi
            bend = above.phi - 2.0 * best.phi + below.phi
            best = self._solve(best.Lambda * (1.0 - 0.5 * spread * slope / bend), best)
        return best

    def gamma_at(self, phi: float) -> float:
        """Gamma on the upper side of the curve, or NaN for phi below the onset."""
        if phi < self.onset.phi:
            return np.nan
        # Lambda is proportional to phi for long rods.
        if phi > self.LONG:
            return self.gamma_at(self.LONG) * (phi / self.LONG) ** 3

        # Two rungs bracket the weight. Each trial starts at the last trial, which is near.
        rung = 0
        while self._rung(rung).phi < phi:
            rung += 1
        last = low = self._rung(rung - 1) if rung > 0 else self.onset
        known = {end.Lambda: end for end in (low, self._rung(rung))}

        def missed(Lambda: float) -> float:
            nonlocal last
            last = known.get(Lambda) or self._solve(Lambda, last)
            return last.phi - phi

        return float(brentq(missed, min(known), max(known), xtol=1e-15, rtol=self.TOLERANCE)) ** 3

    def _rung(self, rung: int) -> _BoundaryPoint:
        """Rung of the ladder. Rung 0 is the anchor, and positive rungs are above it."""
        ladder, ratio = (self._up, self.UP) if rung >= 0 else (self._down, self.DOWN)
        while len(ladder) <= abs(rung):
            ladder.append(self._solve(ladder[0].Lambda * ratio ** len(ladder), ladder[-1]))
        return ladder[abs(rung)]

    def _solve(self, Lambda: float, near: _BoundaryPoint) -> _BoundaryPoint:
        """Find phi for this Lambda, starting from a point nearby."""
        mesh = place = _mesh(Lambda)
        # Rods of more than a few units of sigma look alike in sigma, and shorter rods in s. Beyond
        # the clamp of the near rod the guess takes the values at this clamp.
        if not 0.95 < Lambda / near.Lambda < 1.05:
            place = np.minimum(mesh * Lambda / near.Lambda, 1.0)

        def change(x: Floats, y: Floats, p: Floats) -> Floats:
            return Lambda * _rates(Lambda * x, y, p[0] / Lambda, self.C)

        def ends(tip: Floats, clamp: Floats, _: Floats) -> Floats:
            return np.stack([tip[1], tip[2], tip[3], tip[4] - 1.0, clamp[0], clamp[4]])

        phi = near.phi * max(Lambda / near.Lambda, 1.0)
        solution = solve_boundary_values(change, ends, mesh, near.fields(place), np.array([phi]))
        # A zero of eta before the clamp means that the rod was unstable already.
        if solution.y[4].min() < -1e-9:
            raise NotSolvedError(
                f"bend_twist: at Lambda = {Lambda} another mode becomes unstable first"
            )
        return _BoundaryPoint(Lambda, float(solution.p[0]), solution.sol)

    def _anchor(self) -> _BoundaryPoint:
        """Follow the planar rod from large weights down until eta has passed zero at the clamp.

        Above the boundary eta grows as exp(2/3 Lambda^{3/2}) from the free end to the clamp. With
        eta scaled to one at the clamp the problem is well conditioned, and the sign of eta at the
        free end shows the boundary.
        """
        # A little more than the onset, which is at 5.56 (C = 2/3) ... 6.39 (C = 1).
        phi = 7.0
        mesh = _mesh(phi)
        fields = np.zeros((5, len(mesh)))
        for ratio in np.arange(1.2, 0.3, -0.03):
            Lambda = float(ratio) * phi

            def change(x: Floats, y: Floats, Lambda: float = Lambda) -> Floats:
                return Lambda * _rates(Lambda * x, y, phi / Lambda, self.C)

            def ends(tip: Floats, clamp: Floats) -> Floats:
                return np.stack([tip[1], tip[2], tip[3], clamp[4] - 1.0, clamp[0]])

            solution = solve_boundary_values(change, ends, mesh, fields)
            fields = solution.sol(mesh)
            tip = solution.y[4, 0]
            if tip < 0.0:
                break
        else:
            raise NotSolvedError("bend_twist: the planar rod of phi = 7 stays stable")
        # `_solve` has eta = 1 at the free end, so scale the linear fields to it.
        scale = np.array([1.0, 1.0, tip, tip, tip])[:, None]
        return self._solve(Lambda, _BoundaryPoint(Lambda, phi, lambda x: solution.sol(x) / scale))


def _rates(sigma: Floats, y: Floats, k: float, C: float) -> Floats:
    """Return d/dsigma of (theta, q, mu0, mu1, eta), as in the equations of `bend_twist`."""
    theta, q, mu0, mu1, eta = y
    sine = np.sin(theta)
    cosine = np.cos(theta)
    return np.stack(
        [
            -(k + q),
            -sigma * sine,
            -k * mu1,
            (k + q) * mu0 - q * mu0 / C - sigma * eta,
            -cosine * mu1 - sine * mu0 / C,
        ]
    )


def _mesh(Lambda: float) -> Floats:
    """Return the mesh over sigma / Lambda.

    The mesh is fine in the curled part of the rod. It is wide for sigma > 16, because the rod hangs
    straight there up to rounding.
    """
    if Lambda <= 16.0:
        return np.linspace(0.0, 1.0, 33)
    return np.concatenate(
        [np.linspace(0.0, 16.0 / Lambda, 33), np.geomspace(16.0 / Lambda, 1.0, 9)[1:]]
    )


@lru_cache(maxsize=8)
def _boundary(poisson: float) -> _Boundary:
    return _Boundary(float(within("poisson", poisson, 0.0, 0.5)))
