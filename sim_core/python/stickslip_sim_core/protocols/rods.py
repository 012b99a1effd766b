"""Protocols of the rod solver, with their chains of frames, equilibria and searches."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from stickslip_sim_core import _sim_core
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.protocols.protocol import Protocol
from stickslip_sim_core.protocols.result import Setting
from stickslip_sim_core.reference import master_curves

POISSON = (0.0, 0.3, 0.5)

# Bisections end at this relative width.
BISECTION = 1e-12


@dataclass(frozen=True)
class Equilibrium:
    """An equilibrium of a chain on one level of the solver."""

    gamma: float
    """Weight, rho A g L^3 / EI [-]."""

    frames: Floats
    """Quaternions, shape (N + 1, 4), rows (w, x, y, z); the clamp first."""

    stable: bool
    """Whether the chain is in equilibrium with a positive definite Hessian."""


# Function from a weight and frames to the nearest equilibrium.
Relax = Callable[[float, Floats], Equilibrium]


def round_rod(phi: float, poisson: float) -> Relax:
    """Relax chains of a round rod with natural bend phi / L by the rod solver's Newton method."""

    def relax(gamma: float, frames: Floats) -> Equilibrium:
        return Equilibrium(
            gamma, *_sim_core.relax_rod(gamma, 0.0, phi, 1.0 / (1.0 + poisson), frames)
        )

    return relax


def planar_frames(angles: Floats) -> Floats:
    """Return frames in the plane y = 0 with d3 = -y, shape (N + 1, 4).

    The tangents of the frames make the given angles [rad] with gravity.
    """
    c = np.cos(0.5 * angles)
    s = np.sin(0.5 * angles)
    # The quaternion (1, 1, 1, -1) / 2 of the clamp of solve_rods, times (c, 0, 0, s).
    return 0.5 * np.stack([c + s, c + s, c - s, s - c], axis=1)


def tip(frames: Floats) -> Floats:
    """Return the position of the free end [L], shape (3,).

    The trapezoidal rule integrates r' = d1. Its error is even in h, which `extrapolated` needs.
    """
    w, x, y, z = frames.T
    tangents = np.stack(
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)], axis=1
    )
    weights = np.full(len(w), 1.0 / (len(w) - 1))
    weights[[0, -1]] *= 0.5
    return np.asarray(weights @ tangents)


def extrapolated(measure: Callable[[int], float], elements: int) -> float:
    """Measure with 1/4, 1/2 and all of `elements`, and return the limit with an error O(h^6).

    The rod solver extrapolates in the same way.
    """
    coarse, middle, fine = (measure(elements // k) for k in (4, 2, 1))
    return float(64.0 * fine - 20.0 * middle + coarse) / 45.0


def loss_of_stability(relax: Relax, start: Equilibrium, gammas: Iterable[float]) -> float:
    """Return the weight at which an equilibrium, followed through `gammas`, ceases to be stable.

    It is NaN if the equilibrium stays stable.
    """
    # Each search starts from the last equilibrium, so that it stays on the same branch.
    stable = start
    for gamma in gammas:
        after = relax(float(gamma), stable.frames)
        if not after.stable:
            return _bisected(relax, stable, after.gamma)
        stable = after
    return np.nan


def _bisected(relax: Relax, stable: Equilibrium, unstable: float) -> float:
    """Bisect between a stable equilibrium and a weight at which it is unstable."""
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
    """Number of elements of the finest chain, a multiple of 4, at least 16."""

    def __post_init__(self) -> None:
        # The coarsest chain has a quarter of the elements.
        count = self.elements
        if isinstance(count, bool) or not isinstance(count, int) or count < 16 or count % 4:
            raise ValueError(f"elements: must be a multiple of 4 and at least 16, got {count!r}")

    def reported(self) -> dict[str, Setting]:
        return {"elements": self.elements}


# Natural curvature times L [rad]: 6 ... 25 pi.
PHI = (6.0, 6.5, 7.0, 8.0, 10.0, 12.5, 16.0, 20.0, 27.0, 36.0, 48.0, 62.0, 25.0 * np.pi)

# Factor between the weights of a branch. Close to the onset the three-dimensional window may be
# narrower than a single step. A branch starts at gamma = phi^3, at which every such rod hangs
# almost straight and stable. It ends at gamma = 1e-4 phi^3, at which all of the rod has curled up
# again.
DOWN = 0.9
DOWN_TO = 1e-4


@dataclass(kw_only=True, eq=False)
class BendTwist(RodProtocol):
    """The weight at which a curly rod leaves its plane [Miller et al. 2014; Romero et al. 2021].

    The protocol follows a branch of planar equilibria to the weight at which the Hessian ceases to
    be positive definite. An exactly planar rod stays planar. The master curve is
    `master_curves.bend_twist`.
    """

    name = "bend-twist"
    x_name = "phi"
    y_name = "Gamma"
    points = "phi"
    parameters: ClassVar = {"poisson": "poisson"}

    phi: Sequence[float] = PHI
    """Natural curvatures times L [rad]."""
    poisson: Sequence[float] = POISSON
    elements: int = 1024
    tolerance: float = 1e-4

    def measure(self, phi: float, at: Mapping[str, Any]) -> tuple[float, float]:
        boundary = extrapolated(
            lambda elements: upper_boundary(phi, at["poisson"], elements), self.elements
        )
        return boundary, float(master_curves.bend_twist(phi, at["poisson"]))


def upper_boundary(phi: float, poisson: float, elements: int) -> float:
    """Return the weight at which the planar chain loses stability, or NaN.

    The search follows the chain from large weights downwards.
    """
    relax = round_rod(phi, poisson)
    start = relax(phi**3, planar_frames(np.zeros(elements + 1)))
    if not start.stable:
        raise RuntimeError(
            f"bend-twist: the heavy rod of phi = {phi} is not stable on {elements} elements"
        )
    steps = np.arange(1, np.ceil(np.log(DOWN_TO) / np.log(DOWN)))
    return loss_of_stability(relax, start, phi**3 * DOWN**steps)


# Weights rho A g L^3 / EI [-]: 1e-3 ... 1e5.
GAMMA = tuple(float(g) for g in 10.0 ** np.arange(-3.0, 5.1, 0.5))


@dataclass(kw_only=True, eq=False)
class RodCantilever(RodProtocol):
    """H/W, drop of the tip over its horizontal reach, against `master_curves.cantilever`."""

    name = "rod-cantilever"
    x_name = "Gamma"
    y_name = "H/W"
    points = "gamma"

    gamma: Sequence[float] = GAMMA
    elements: int = 2048
    tolerance: float = 1e-4

    def measure(self, gamma: float, at: Mapping[str, Any]) -> tuple[float, float]:
        drop = extrapolated(lambda elements: drop_over_reach(gamma, elements), self.elements)
        return drop, float(master_curves.cantilever(gamma))


def drop_over_reach(gamma: float, elements: int) -> float:
    """Return H/W of a straight chain clamped horizontally, or NaN if it is not stable."""
    straight = planar_frames(np.full(elements + 1, 0.5 * np.pi))
    hanging = round_rod(0.0, 0.5)(gamma, straight)
    if not hanging.stable:
        return np.nan
    x, y, z = tip(hanging.frames)
    return float(-z / np.hypot(x, y))


# Bending stiffness in the strip's plane over the stiffness across it. The buckling weight is a
# power series in the inverse of this ratio.
STIFFNESS_RATIOS = (1000.0, 2000.0, 4000.0)

# The weight over sqrt(EI GJ) grows from half of the buckling weight, by this factor in each step.
UP_FROM = 6.0
UP = 1.1
UP_TO = 60.0


@dataclass(kw_only=True, eq=False)
class RodLateralBuckling(RodProtocol):
    """The weight at which a strip that is clamped edge-on buckles sideways.

    The weight of a strip grows while the strip stays in its vertical plane, until the Hessian
    ceases to be positive definite. Extrapolation then gives the limit of a strip that does not bend
    in its plane. The master curve is `master_curves.lateral_buckling_rod`.
    """

    name = "rod-lateral-buckling"
    x_name = "poisson"
    y_name = "rho A g L^3 / sqrt(EI GJ)"
    points = "poisson"
    constants: ClassVar = {"stiffness_ratios": STIFFNESS_RATIOS}

    poisson: Sequence[float] = POISSON
    elements: int = 128
    tolerance: float = 1e-4

    def measure(self, poisson: float, at: Mapping[str, Any]) -> tuple[float, float]:
        single, double, fourfold = (
            extrapolated(partial(buckling_weight, poisson, ratio), self.elements)
            for ratio in STIFFNESS_RATIOS
        )
        return (8.0 * fourfold - 6.0 * double + single) / 3.0, master_curves.lateral_buckling_rod()


def buckling_weight(poisson: float, stiffness_ratio: float, elements: int) -> float:
    """Return rho A g L^3 / sqrt(EI GJ) at which a chain loses stability, or NaN."""
    # A thin strip: EI = Y w t^3 / 12 across its plane, GJ = Y w t^3 / (6 (1 + poisson)).
    twist = 2.0 / (1.0 + poisson)
    # The strip hardly bends about d3 = -y.
    stiffness = np.array([twist, 1.0, stiffness_ratio])
    straight = np.zeros((elements, 3))

    def relax(gamma: float, frames: Floats) -> Equilibrium:
        return Equilibrium(gamma, *_sim_core.relax_chain(gamma, stiffness, straight, frames))

    horizontal = planar_frames(np.full(elements + 1, 0.5 * np.pi))
    start = relax(UP_FROM * np.sqrt(twist), horizontal)
    if not start.stable:
        return np.nan
    steps = np.arange(1, np.ceil(np.log(UP_TO / UP_FROM) / np.log(UP)))
    return loss_of_stability(relax, start, start.gamma * UP**steps) / float(np.sqrt(twist))
