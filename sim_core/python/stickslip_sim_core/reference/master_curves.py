"""Master curves: the values that physics predicts for the protocols.

They are computed here and never tabulated.

Every curve of a rod, or of a strip that bends in one direction, comes from the differential
equations of the continuous rod, solved by scipy's collocation to 1e-9; that of a plate from
plate_buckling.py, to 5e-5. They share nothing with the solvers that are measured, so that a
protocol compares two independent computations. Symbols, definitions and figures: docs/protocols.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_bvp
from scipy.optimize import brentq
from scipy.special import jv

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.reference import plate_buckling

TOLERANCE = 1e-9
"""Residual of the differential equations, relative."""


class NotSolvedError(RuntimeError):
    """A boundary value problem has no solution near the guess, or not the one that is meant."""


def cantilever(gamma: ArrayLike) -> Floats:
    """Return H/W of a heavy elastica clamped horizontally.

    H is the drop of its tip, W its horizontal reach.

    With psi the angle from the downward vertical to the tangent and primes d/ds,

        psi'' = gamma (1 - s) sin psi,   psi(0) = pi/2,   psi'(1) = 0,
        H = int cos psi ds,   W = int sin psi ds.

    Of the solutions the one with 0 < psi <= pi/2 is meant; there the energy is convex, so there is
    no other such.

    Args:
        gamma: Weight against bending, rho A g L^3 / EI [-], > 0, any shape.

    Raises:
        ValueError: A gamma is not positive and finite.
    """
    values = _positive("gamma", gamma)
    return np.array([_cantilever(float(g)) for g in values.ravel()]).reshape(values.shape)


def _cantilever(gamma: float) -> float:
    # Widths of the layers at the clamp and at the free end; the fields are psi, psi' / rate, and H
    # and W, both scaled.
    rate = max(1.0, np.sqrt(gamma))
    clamp = 1.0 / rate
    tip = min(1.0, gamma ** (-1.0 / 3.0))
    mesh = np.unique(
        np.concatenate(
            [np.geomspace(0.25 * clamp, 0.5, 16), 1.0 - tip * np.linspace(0.0, 0.5, 5), [0.0]]
        )
    )

    light = min(1.0, gamma)

    def change(s: Floats, y: Floats) -> Floats:
        psi, bend, _, _ = y
        return np.stack(
            [
                rate * bend,
                gamma / rate * (1.0 - s) * np.sin(psi),
                np.cos(psi) / light,
                rate * np.sin(psi),
            ]
        )

    def ends(clamp: Floats, tip: Floats) -> Floats:
        return np.stack([clamp[0] - np.pi / 2.0, tip[1], clamp[2], clamp[3]])

    hanging = np.pi / 2.0 * np.exp(-mesh * np.sqrt(gamma))
    found = _solved(
        change, ends, mesh, np.stack([hanging, -hanging * np.sqrt(gamma) / rate, mesh, mesh])
    )
    psi, _, drop, reach = found.y
    if psi.min() < -1e-9 or psi.max() > np.pi / 2.0 + 1e-9:
        raise NotSolvedError(f"cantilever: the solution at gamma = {gamma} is not the hanging one")
    return float(light * rate * drop[-1] / reach[-1])


def lateral_buckling_rod() -> float:
    """Return the weight rho A g L^3 / sqrt(EI GJ) at which a strip buckles sideways.

    The strip is clamped edge-on, in the limit w/L -> 0.

    A strip that cannot bend in its own plane stays straight until then. With x from the free end,
    EI its bending stiffness across the plane, GJ its twisting stiffness and eta the sideways slope,

        eta'' + (weight / 2)^2 x^4 eta = 0,   eta'(0) = 0,   eta(1) = 0,
        eta = sqrt(x) J_{-1/6}(weight x^3 / 6)

    [Prandtl 1899]: six times the first zero of the Bessel function J_{-1/6}.
    """
    return 6.0 * float(brentq(partial(jv, -1.0 / 6.0), 1.5, 2.5, xtol=1e-15))


def lateral_buckling(aspect: ArrayLike, poisson: float) -> Floats:
    """Return the weight Gamma* = rho_A g L^3 / D at which a plate strip buckles, to 5e-5.

    The strip is clamped edge-on and buckles sideways.

    The strip of length L and width aspect * L is clamped along one short edge, with its width
    vertical, in displacement and slope; its other edges are free. rho_A is its mass per area, D = Y
    h^3 / (12 (1 - poisson^2)) its bending rigidity, so that per unit of rho_A g L^3 / (Y h^3 / 12)
    the answer is Gamma* / (1 - poisson^2). Plane stress under its weight and Kirchhoff's plate,
    both linear until it buckles: a strip much thinner than wide. How they are solved:
    plate_buckling.py. As aspect goes to zero,

        Gamma* = lateral_buckling_rod() sqrt(2 / (1 + poisson)) (1 - poisson^2) (1 + O(aspect)).

    Args:
        aspect: Width over length [-], in [0.01, 1], any shape.
        poisson: Poisson's ratio [-], in [0, 0.5].

    Raises:
        ValueError: An argument breaks its rule.
    """
    values = _within("aspect", aspect, 0.01, 1.0)
    nu = float(_within("poisson", poisson, 0.0, 0.5))
    return np.array([plate_buckling.buckling_weight(float(v), nu) for v in values.ravel()]).reshape(
        values.shape
    )


def stick_slip(strain: ArrayLike) -> Floats:
    """Return mu = Q/P of a strip pressed end-on against a wall: at less friction its tip slips.

    The strip of length 1 is clamped at the origin, upright; the wall has come down from height 1 to
    1 - strain, and acts on the tip with (Q, -P) in units of EI / L^2. With theta from the x axis to
    the tangent and primes d/ds,

        theta'' = P cos theta + Q sin theta,   x' = cos theta,   y' = sin theta,
        theta(0) = pi/2,   theta'(1) = 0,   x(0) = y(0) = x(1) = 0,   y(1) = 1 - strain

    (the thesis's Eq. 3.1 with its sine and cosine the right way round) [Sano et al. 2017]. The tip,
    on its line, sticks while mu >= Q/P. Of the two mirrored solutions that with theta(1) > pi/2, Q
    > 0 is meant, of all the modes the first one: P = 20.1907 at buckling. For small strains Q/P =
    0.44510 sqrt(strain).

    Beyond `stick_slip_triple_point` there is no answer: the strip lies on the wall with more than
    its tip.

    Args: strain: Displacement of the wall over the length of the strip [-], > 0 and at most that of
        the triple point (to 1e-9), any shape.

    Raises:
        ValueError: A strain is outside its range.
    """
    values = _within(
        "strain", strain, 0.0, stick_slip_triple_point()[0] * (1.0 + 1e-9), open_below=True
    )

    def friction(e: float) -> float:
        return _pressed(lambda w, p: p[2] - np.sqrt(e), e)[1]

    return np.array([friction(float(e)) for e in values.ravel()]).reshape(values.shape)


def stick_slip_strain(friction: ArrayLike) -> Floats:
    """Return the strain at which a strip slips that is pressed end-on against a wall.

    It is the inverse of `stick_slip`.

    Args: friction: Coefficient of friction mu [-], > 0 and at most that of the triple point (to
        1e-9), any shape. At a higher one the strip never slips.

    Raises:
        ValueError: A friction is outside its range.
    """
    top_strain, top = stick_slip_triple_point()
    values = _within("friction", friction, 0.0, top * (1.0 + 1e-9), open_below=True)

    def strain(mu: float) -> float:
        return _pressed(lambda w, p: p[1] * p[2] - mu * p[0], top_strain * (mu / top) ** 2)[0]

    return np.array([strain(float(mu)) for mu in values.ravel()]).reshape(values.shape)


@lru_cache(maxsize=1)
def stick_slip_triple_point() -> tuple[float, float]:
    """Return (strain, mu) at which sticking, slipping and lying on the wall meet.

    There, theta(1) = pi.
    """
    return _pressed(lambda w, p: p[2] * w - np.pi / 2.0, 0.33)


def _pressed(condition: Callable[[float, Floats], float], guess: float) -> tuple[float, float]:
    """Return (strain, Q/P) of the strip that fulfils a further condition.

    The condition is on w(1) and (P, q, a); the search begins at a guessed strain.

    With a = sqrt(strain), theta = pi/2 + a w and Q = a q the problem has no bifurcation, and a may
    be as small as it likes:

        w'' = -P sin(a w) / a + q cos(a w),   w(0) = w'(1) = 0,
        int sin(a w) / a = 0,   int (1 - cos(a w)) / a^2 = 1.

    For a = 0 its solution is w = (q / P) (1 - cos(k s) - k sin(k s)), tan k = k, P = k^2.
    """

    def change(_: Floats, y: Floats, p: Floats) -> Floats:
        w = y[0]
        bend = y[1]
        P, q, a = p
        sine = np.sin(a * w) / a
        return np.stack(
            [bend, q * np.cos(a * w) - P * sine, sine, 0.5 * (np.sin(0.5 * a * w) / (0.5 * a)) ** 2]
        )

    def ends(first: Floats, last: Floats, p: Floats) -> Floats:
        at_clamp = [first[0], first[2], first[3]]
        return np.stack([*at_clamp, last[1], last[2], last[3] - 1.0, condition(last[0], p)])

    k = 4.493409457909064
    s = np.linspace(0.0, 1.0, 7)
    w = 1.0 - np.cos(k * s) - k * np.sin(k * s)
    bend = k * (np.sin(k * s) - k * np.cos(k * s))
    scale = 0.44510  # q / P that makes int w^2 = 2
    y = np.stack([scale * w, scale * bend, 0.0 * s, s])
    found = _solved(change, ends, s, y, np.array([k**2, scale * k**2, np.sqrt(guess)]))
    P, q, a = found.p
    w = found.y[0]
    if not (P > 0.0 and q > 0.0 and a * w.max() <= np.pi / 2.0 + 1e-6 and w[-1] > w.max() - 1e-9):
        raise NotSolvedError(
            f"stick_slip: near strain = {guess} the solution found is not the first mode"
        )
    return float(a**2), float(a * q / P)


def bend_twist(phi: ArrayLike, poisson: float) -> Floats:
    """Return the weight Gamma above which a curly rod hangs in a plane.

    Below it the rod turns three-dimensional.

    The rod has natural curvature phi / L about d3 and no natural twist, GJ/EI = C = 1/(1 +
    poisson), and is clamped with its tangent along gravity. The boundary is the Gamma at which the
    planar equilibrium, followed from large Gamma downwards, ceases to be a strict minimum over all
    rotations. NaN where phi is below `bend_twist_onset`: there the planar equilibrium is stable for
    every weight.

    With Lambda = Gamma^{1/3}, k = phi / Lambda, sigma = (1 - s) Lambda from the free end and a dot
    for d/dsigma, the planar rod [theta: angle from gravity to tangent; q: moment about d3] is

        theta. = -(k + q),   q. = -sigma sin theta,   q(0) = 0,   theta(Lambda) = 0.

    Its linearised Kirchhoff equations out of the plane [mu0, mu1: moments about d1, d2; eta: slope
    of the tangent] are

        mu0. = -k mu1,   mu1. = (k + q) mu0 - q mu0 / C - sigma eta,
        eta. = -cos(theta) mu1 - sin(theta) mu0 / C

    from mu0 = mu1 = 0, eta = 1 at the free end: the rotation about gravity being the other
    solution, the determinant of Jacobi's fields is eta. The planar rod is a minimum while eta has
    no zero; on the boundary the first zero, coming from infinity, is at the clamp: eta(Lambda) = 0.

    Args:
        phi: Natural curvature times L [rad], > 0, any shape.
        poisson: Poisson's ratio [-], in [0, 0.5].

    Raises:
        ValueError: An argument breaks its rule.
    """
    values = _positive("phi", phi)
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
    """Gamma^{1/3}."""

    phi: float
    fields: Callable[[Floats], Floats]
    """(theta, q, mu0, mu1, eta) over sigma / Lambda."""


class _Boundary:
    """The boundary curve of a Poisson's ratio, (Lambda, phi(Lambda)).

    It is followed from an anchor along a ladder.

    The ladder of Lambda is climbed from the anchor always, so that no point depends on earlier
    calls.
    """

    UP, DOWN = 1.1, 0.97  # ratios of neighbours on the ladder: below the anchor rods differ more
    TOLERANCE = 1e-12  # on Lambda, relative
    # phi from which rods are alike: their fields fall as exp(-(2/3) sigma^1.5), to 1e-30 at the
    # clamp
    LONG = 40.0

    def __init__(self, poisson: float) -> None:
        self.C = 1.0 / (1.0 + poisson)
        self._up = [self._anchor()]
        self._down = [self._up[0]]

    @cached_property
    def onset(self) -> _BoundaryPoint:
        """The point of least phi, by parabolas through three points ever closer."""
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
        """Gamma on the upper side of the curve, NaN if there is none."""
        if phi < self.onset.phi:
            return np.nan
        if phi > self.LONG:
            return self.gamma_at(self.LONG) * (phi / self.LONG) ** 3
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
        """Rung of the ladder: 0 is the anchor, positive ones are above."""
        ladder, ratio = (self._up, self.UP) if rung >= 0 else (self._down, self.DOWN)
        while len(ladder) <= abs(rung):
            ladder.append(self._solve(ladder[0].Lambda * ratio ** len(ladder), ladder[-1]))
        return ladder[abs(rung)]

    def _solve(self, Lambda: float, near: _BoundaryPoint) -> _BoundaryPoint:
        """Find phi for this Lambda, from a point near by."""
        mesh = place = _mesh(Lambda)
        # Rods of more than a few units of sigma look alike in sigma, shorter ones in s.
        if not 0.95 < Lambda / near.Lambda < 1.05:
            place = np.minimum(mesh * Lambda / near.Lambda, 1.0)  # beyond its clamp as at its clamp

        def change(x: Floats, y: Floats, p: Floats) -> Floats:
            return Lambda * _rates(Lambda * x, y, p[0] / Lambda, self.C)

        def ends(tip: Floats, clamp: Floats, _: Floats) -> Floats:
            return np.stack([tip[1], tip[2], tip[3], tip[4] - 1.0, clamp[0], clamp[4]])

        phi = near.phi * max(Lambda / near.Lambda, 1.0)
        found = _solved(change, ends, mesh, near.fields(place), np.array([phi]))
        if found.y[4].min() < -1e-9:
            raise NotSolvedError(
                f"bend_twist: at Lambda = {Lambda} another mode becomes unstable first"
            )
        return _BoundaryPoint(Lambda, float(found.p[0]), found.sol)

    def _anchor(self) -> _BoundaryPoint:
        """Follow the planar rod from large weights down until eta has passed zero at the clamp.

        Above the boundary eta grows as exp(2/3 Lambda^{3/2}) from the free end to the clamp; scaled
        to one at the clamp the problem is a good one, and the sign to watch is that at the free
        end.
        """
        phi = 7.0  # a little more than the onset, which is at 5.56 (C = 2/3) ... 6.39 (C = 1)
        mesh = _mesh(phi)
        fields = np.zeros((5, len(mesh)))
        for ratio in np.arange(1.2, 0.3, -0.03):
            Lambda = float(ratio) * phi

            def change(x: Floats, y: Floats, Lambda: float = Lambda) -> Floats:
                return Lambda * _rates(Lambda * x, y, phi / Lambda, self.C)

            def ends(tip: Floats, clamp: Floats) -> Floats:
                return np.stack([tip[1], tip[2], tip[3], clamp[4] - 1.0, clamp[0]])

            found = _solved(change, ends, mesh, fields)
            fields = found.sol(mesh)
            tip = found.y[4, 0]
            if tip < 0.0:
                break
        else:
            raise NotSolvedError("bend_twist: the planar rod of phi = 7 stays stable")
        scale = np.array([1.0, 1.0, tip, tip, tip])[:, None]
        return self._solve(Lambda, _BoundaryPoint(Lambda, phi, lambda x: found.sol(x) / scale))


def _rates(sigma: Floats, y: Floats, k: float, C: float) -> Floats:
    """d/dsigma of (theta, q, mu0, mu1, eta): see bend_twist."""
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

    It is fine where the rod curls, and wide where it hangs straight to rounding (sigma > 16).
    """
    if Lambda <= 16.0:
        return np.linspace(0.0, 1.0, 33)
    return np.concatenate(
        [np.linspace(0.0, 16.0 / Lambda, 33), np.geomspace(16.0 / Lambda, 1.0, 9)[1:]]
    )


@lru_cache(maxsize=8)
def _boundary(poisson: float) -> _Boundary:
    return _Boundary(float(_within("poisson", poisson, 0.0, 0.5)))


def capstan(mu: ArrayLike, wrap: float, bending: float = 0.0) -> Floats:
    """Return T2/T1, the ratio of a heavy pull and a light one, of a strip over a cylinder.

    The strip slides.

    A strip without weight, of stiffness D against bending, goes over a cylinder of radius R. With B
    = D / (2 R^2) each free end meets the cylinder where 1 - cos(phi_i) = B / T_i, and presses on it
    there with sqrt(2 T_i B - B^2), which rubs, too:

        N1 = T1 - B + mu sqrt(2 T1 B - B^2),
        T2 - B - mu sqrt(2 T2 B - B^2) = N1 exp(mu (wrap - phi_1 - phi_2)).

    Without bending it is Euler's exp(mu wrap) [Euler 1769; Stuart 1961].

    Args:
        mu: Coefficient of friction, >= 0, any shape.
        wrap: Angle between the far directions of both ends [rad], > 0.
        bending: B / T1, in [0, 1).

    Raises:
        ValueError: An argument breaks its rule, or the strip does not lie on the cylinder.
    """
    values = _within("mu", mu, 0.0, np.inf)
    _positive("wrap", wrap)
    _within("bending", bending, 0.0, 1.0 - 1e-12)
    return np.array(
        [_capstan(float(m), float(wrap), float(bending)) for m in values.ravel()]
    ).reshape(values.shape)


def _capstan(mu: float, wrap: float, bending: float) -> float:
    first = np.arccos(1.0 - bending)
    if not wrap > 2.0 * first:
        raise ValueError(
            f"wrap: must be above {2.0 * first:.4g} rad at bending = {bending}, got {wrap}"
        )
    light = 1.0 - bending + mu * np.sqrt(2.0 * bending - bending**2)

    def missed(heavy: float) -> float:
        tail = mu * np.sqrt(2.0 * heavy * bending - bending**2)
        lying = wrap - first - np.arccos(1.0 - bending / heavy)
        return float((heavy - bending - tail) / (light * np.exp(mu * lying)) - 1.0)

    high = 2.0
    while missed(high) < 0.0:
        high *= 2.0
    return float(brentq(missed, 1.0, high, xtol=1e-14))


@dataclass(frozen=True)
class HeavyFold:
    """A fold at rest, in units of the gravito-bending length L_gb = (D / (rho g))^(1/3)."""

    height: float
    """Of its highest point over the layer below."""

    loop_length: float
    """Of the strip between where it lifts off and where it lands."""

    nose_to_landing: float
    """Horizontal distance."""

    landing_force: float
    """Of the layer below on the strip where it lands, over rho g L_gb."""

    tension: float
    """Of the strip where it lands, likewise: what holds the upper layer back besides friction."""

    def pull(self, mu: ArrayLike, tail: ArrayLike) -> Floats:
        """Return the force over rho g L_gb, away from the loop, at which the upper layer slips.

        The force is horizontal.

        Friction bears mu (weight of the tail + landing force), and the loop holds back by its
        tension.

        Args:
            mu: Friction of the strip with itself.
            tail: Length of the strip beyond the landing, over L_gb.
        """
        return np.asarray(mu) * (np.asarray(tail) + self.landing_force) + self.tension


@lru_cache
def heavy_fold(gap: float) -> HeavyFold:
    """Return the shape of a strip that is folded onto itself on a floor under its own weight.

    With theta the angle of the tangent, which lifts off at s = 0 and lands on the layer below at
    the height `gap`, kappa = theta', and the force (H, V + s) in the strip,

        kappa' = H sin(theta) - (V + s) cos(theta),   x' = cos(theta),   y' = sin(theta),
        theta = kappa = y = 0 at s = 0,   theta = pi, kappa = 0, y = gap at the end.

    kappa^2/2 + n . t - y is constant, so that H = -gap/2: friction changes nothing.

    Args:
        gap: Height of the upper layer over the lower one where it lands, over L_gb, in (0, 0.5].

    Raises:
        ValueError: The gap breaks its rule.
    """
    _within("gap", gap, 0.0, 0.5, open_below=True)

    def change(s: Floats, y: Floats, p: Floats) -> Floats:
        (theta, kappa, _, _) = y
        (H, V, length) = p
        bend = H * np.sin(theta) - (V + s * length) * np.cos(theta)
        return np.asarray(length * np.stack([kappa, bend, np.cos(theta), np.sin(theta)]))

    def ends(first: Floats, last: Floats, _: Floats) -> Floats:
        return np.array([*first, last[0] - np.pi, last[1], last[3] - gap])

    # A guess that rises to 1.3 pi and comes back, by eye.
    s = np.linspace(0.0, 1.0, 101)
    theta = np.where(
        s < 0.5, np.pi * 1.3 * np.sin(np.pi * s) ** 2, np.pi * (1.0 + 0.3 * np.sin(np.pi * s) ** 2)
    )
    x, y = (0.05 * np.cumsum(rate(theta)) for rate in (np.cos, np.sin))
    found = _solved(
        change,
        ends,
        s,
        np.stack([theta, np.gradient(theta, 0.05), x, y]),
        np.array([0.0, -3.0, 5.0]),
    )
    H, V, length = found.p
    nose, top = (
        found.sol(
            brentq(
                lambda s, angle=angle: found.sol(s)[0] - angle, 0.0, found.x[found.y[0].argmax()]
            )
        )
        for angle in (np.pi / 2.0, np.pi)
    )
    if not (found.y[0].max() > np.pi and length > 0.0 and V < 0.0):
        raise NotSolvedError(f"heavy_fold: the solution at gap = {gap} is not the fold")
    return HeavyFold(
        height=float(top[3]),
        loop_length=float(length),
        nose_to_landing=float(nose[2] - found.y[2, -1]),
        landing_force=float(V + length),
        tension=-float(H),
    )


def _solved(rate: Any, ends: Any, mesh: Floats, y: Floats, parameters: Floats | None = None) -> Any:
    """Solve y' = rate(x, y, p) with ends(y(first), y(last), p) = 0, from a guess.

    P where there are parameters.
    """
    found = solve_bvp(rate, ends, mesh, y, parameters, tol=TOLERANCE, max_nodes=100_000)
    if not found.success:
        raise NotSolvedError(found.message)
    return found


def _positive(name: str, values: ArrayLike) -> Floats:
    """Return `values` as float64 of their own shape."""
    array = _real(name, values)
    wrong = array[~(np.isfinite(array) & (array > 0.0))]
    if wrong.size:
        raise ValueError(f"{name}: must be finite and > 0, got {wrong.flat[0]}")
    return array


def _within(
    name: str, values: ArrayLike, low: float, high: float, *, open_below: bool = False
) -> Floats:
    """Return `values` as float64 of their own shape."""
    array = _real(name, values)
    above = array > low if open_below else array >= low
    wrong = array[~(above & (array <= high))]
    if wrong.size:
        bracket = "(" if open_below else "["
        raise ValueError(
            f"{name}: must be in {bracket}{low:.10g}, {high:.10g}], got {wrong.flat[0]}"
        )
    return array


def _real(name: str, values: ArrayLike) -> Floats:
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: must be real numbers, got dtype {array.dtype}")
    return array.astype(np.float64)
