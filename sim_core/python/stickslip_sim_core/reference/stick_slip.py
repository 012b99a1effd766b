"""Master curves of a strip that is pressed end-on against a wall until its tip slips."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.reference.boundary_values import (
    NotSolvedError,
    solve_boundary_values,
    within,
)


def stick_slip(strain: ArrayLike) -> Floats:
    """Return mu = Q/P of a strip pressed end-on against a wall: at less friction its tip slips.

    The strip of length 1 is clamped upright at the origin. The wall has come down from height 1 to
    1 - strain, and acts on the tip with (Q, -P) in units of EI / L^2. With the angle theta from the
    x axis to the tangent and primes d/ds,

        theta'' = P cos theta + Q sin theta,   x' = cos theta,   y' = sin theta,
        theta(0) = pi/2,   theta'(1) = 0,   x(0) = y(0) = x(1) = 0,   y(1) = 1 - strain

    [Sano et al. 2017]. The thesis's Eq. 3.1 exchanges sine and cosine. The tip, on its line, sticks
    while mu >= Q/P. The curve takes the first mode, with P = 20.1907 at buckling. Of its two
    mirrored solutions it takes the solution with theta(1) > pi/2, Q > 0. For small strains Q/P =
    0.44510 sqrt(strain).

    The curve ends at `stick_slip_triple_point`. Beyond it the strip lies on the wall with more than
    its tip.

    Args:
        strain: Displacement of the wall over the length of the strip [-], any shape. It is > 0 and
            at most the strain of the triple point (to 1e-9).

    Raises:
        ValueError: A strain is outside its range.
    """
    values = within(
        "strain", strain, 0.0, stick_slip_triple_point()[0] * (1.0 + 1e-9), open_below=True
    )

    def friction(e: float) -> float:
        return _pressed(lambda w, p: p[2] - np.sqrt(e), e)[1]

    return np.array([friction(float(e)) for e in values.ravel()]).reshape(values.shape)


def stick_slip_strain(friction: ArrayLike) -> Floats:
    """Return the strain at which a strip that is pressed end-on against a wall slips.

    It is the inverse of `stick_slip`.

    Args:
        friction: Coefficient of friction mu [-], any shape. It is > 0 and at most the friction of
            the triple point (to 1e-9). At a higher friction the strip never slips.

    Raises:
        ValueError: A friction is outside its range.
    """
    top_strain, top = stick_slip_triple_point()
    values = within("friction", friction, 0.0, top * (1.0 + 1e-9), open_below=True)

    def strain(mu: float) -> float:
        return _pressed(lambda w, p: p[1] * p[2] - mu * p[0], top_strain * (mu / top) ** 2)[0]

    return np.array([strain(float(mu)) for mu in values.ravel()]).reshape(values.shape)


@lru_cache(maxsize=1)
def stick_slip_triple_point() -> tuple[float, float]:
    """Return (strain, mu) at which sticking, slipping and lying on the wall meet.

    At this point theta(1) = pi.
    """
    return _pressed(lambda w, p: p[2] * w - np.pi / 2.0, 0.33)


def _pressed(condition: Callable[[float, Floats], float], guess: float) -> tuple[float, float]:
    """Return (strain, Q/P) of the strip that fulfils a further condition.

    The condition is on w(1) and (P, q, a). The search begins at a guessed strain.

    With a = sqrt(strain), theta = pi/2 + a w and Q = a q the problem has no bifurcation, and a may
    be arbitrarily small:

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

    # The guess is the solution for a = 0. k is the first root of tan k = k above zero.
    k = 4.493409457909064
    s = np.linspace(0.0, 1.0, 7)
    w = 1.0 - np.cos(k * s) - k * np.sin(k * s)
    bend = k * (np.sin(k * s) - k * np.cos(k * s))
    # The value of q / P for which int w^2 = 2.
    scale = 0.44510
    y = np.stack([scale * w, scale * bend, 0.0 * s, s])
    solution = solve_boundary_values(
        change, ends, s, y, np.array([k**2, scale * k**2, np.sqrt(guess)])
    )
    P, q, a = solution.p
    w = solution.y[0]
    if not (P > 0.0 and q > 0.0 and a * w.max() <= np.pi / 2.0 + 1e-6 and w[-1] > w.max() - 1e-9):
        raise NotSolvedError(
            f"stick_slip: near strain = {guess} the solution found is not the first mode"
        )
    return float(a**2), float(a * q / P)
