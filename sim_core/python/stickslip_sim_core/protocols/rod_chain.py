"""Chains of the rod solver as the protocols use them: given frames, equilibria, extrapolation, searches."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from stickslip_sim_core import _sim_core
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.protocols.protocol import Protocol
from stickslip_sim_core.protocols.result import Setting

# Bisections end at this relative width.
BISECTION = 1e-12


@dataclass(frozen=True)
class Equilibrium:
    """Where a chain came to rest on one level of the solver."""

    gamma: float
    """Weight, rho A g L^3 / EI [-]."""

    frames: Floats
    """Quaternions, shape (N + 1, 4), rows (w, x, y, z); the clamp first."""

    stable: bool
    """In equilibrium, with a positive definite Hessian."""


# From a weight and frames to the equilibrium next to them.
Relax = Callable[[float, Floats], Equilibrium]


def round_rod(phi: float, poisson: float) -> Relax:
    """Relax chains of a round rod with natural bend phi / L by the rod solver's Newton method."""

    def relax(gamma: float, frames: Floats) -> Equilibrium:
        at_rest, _, stable, *_ = _sim_core.relax_rod(gamma, 0.0, phi, 1.0 / (1.0 + poisson), frames)
        return Equilibrium(gamma, at_rest, stable)

    return relax


def planar_frames(angles: Floats) -> Floats:
    """Frames in the plane y = 0, d3 = -y, whose tangents make these angles [rad] with gravity, shape (N + 1, 4)."""
    c, s = np.cos(0.5 * angles), np.sin(0.5 * angles)
    # (1, 1, 1, -1) / 2, the clamp of solve_rods, times (c, 0, 0, s).
    return 0.5 * np.stack([c + s, c + s, c - s, s - c], axis=1)


def tip(frames: Floats) -> Floats:
    """Position of the free end [L], shape (3,): r' = d1 by the trapezoidal rule, whose error is even in h."""
    w, x, y, z = frames.T
    tangents = np.stack([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)], axis=1)
    weights = np.full(len(w), 1.0 / (len(w) - 1))
    weights[[0, -1]] *= 0.5
    return np.asarray(weights @ tangents)


def extrapolated(measure: Callable[[int], float], elements: int) -> float:
    """Measure with 1/4, 1/2 and all of `elements` and go to the limit, as the solver does: error O(h^6)."""
    coarse, middle, fine = (measure(elements // k) for k in (4, 2, 1))
    return float(64.0 * fine - 20.0 * middle + coarse) / 45.0


def loss_of_stability(relax: Relax, start: Equilibrium, gammas: Iterable[float]) -> float:
    """Follow a stable equilibrium through `gammas` and bisect where it ceases to be stable; NaN where it does not."""
    stable = start
    for gamma in gammas:
        after = relax(float(gamma), stable.frames)
        if not after.stable:
            return _bisected(relax, stable, after.gamma)
        stable = after
    return np.nan


def _bisected(relax: Relax, stable: Equilibrium, unstable: float) -> float:
    """Bisect between a stable equilibrium and a weight at which it is not."""
    while abs(unstable - stable.gamma) > BISECTION * unstable:
        middle = relax(0.5 * (stable.gamma + unstable), stable.frames)
        if middle.stable:
            stable = middle
        else:
            unstable = middle.gamma
    return 0.5 * (stable.gamma + unstable)


@dataclass(kw_only=True, eq=False)
class RodProtocol(Protocol):
    """A protocol of the rod solver.

    Raises:
        ValueError: `elements` breaks its rule.
    """

    elements: int
    """Of the finest chain, a multiple of 4, at least 16."""

    def __post_init__(self) -> None:
        count = self.elements
        if isinstance(count, bool) or not isinstance(count, int) or count < 16 or count % 4:
            raise ValueError(f"elements: must be a multiple of 4 and at least 16, got {count!r}")

    def reported(self) -> dict[str, Setting]:
        return {"elements": self.elements}
