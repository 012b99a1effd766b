"""Random rods for the benchmarks: the thesis's family of three numbers, and rods that vary along their length."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from stickslip_sim_core import solve_general_rods, solve_rods

Floats = npt.NDArray[np.float64]

POINTS = 150
S = np.linspace(0.0, 1.0, POINTS)

RANGES = {"gamma": (100.0, 1300.0), "phi0": (0.2, 12.0), "phi1": (6.0, 20.0)}  # [thesis, 5.4.1]

WAVES = 3
DEVIATION = np.array([2.0, 2.0, 3.0])
"""Standard deviations of the first cosine of twist, bend1 and bend2 [rad]; that of the k-th is a k-th of it."""


@dataclass(frozen=True)
class Rods:
    """Hung rods: gamma (n,), natural curvature, centreline and strains (n, 150, 3)."""

    gamma: Floats
    natural: Floats
    centerline: Floats
    strains: Floats

    def __len__(self) -> int:
        return len(self.gamma)

    def __getitem__(self, some: slice | npt.NDArray[np.int64]) -> "Rods":
        return Rods(self.gamma[some], self.natural[some], self.centerline[some], self.strains[some])


def draw_parameters(count: int, random: np.random.Generator) -> Floats:
    """Return (gamma, phi0, phi1), (3, count), uniform over the thesis's ranges."""
    low, high = np.array(list(RANGES.values())).T
    return np.asarray(random.uniform(low, high, (count, 3)).T)


def family_rods(count: int, random: np.random.Generator) -> Rods:
    """Return rods of the thesis's family."""
    gamma, phi0, phi1 = draw_parameters(count, random)
    solution = solve_rods(gamma, phi0, phi1)
    natural = np.broadcast_to(np.stack([phi0, 0 * phi0, phi1], axis=1)[:, None], solution.curvature.shape)
    return Rods(gamma, natural, solution.centerline, solution.curvature)


def varying_rods(count: int, random: np.random.Generator) -> Rods:
    """Return rods whose natural curvature has three cosines per component on top of the thesis's (phi0, 0, phi1)."""
    return _hung(count, random, lambda missing: cosines(random.normal(size=(missing, WAVES, 3))))


def bumpy_rods(count: int, random: np.random.Generator) -> Rods:
    """Return rods whose natural curvature has a bump of each component somewhere on top of the thesis's."""

    def bumps(missing: int) -> Floats:
        place, width = random.uniform([0.1, 0.05], [0.9, 0.2], (missing, 3, 2)).transpose(2, 0, 1)[:, :, None]
        height = 1.5 * DEVIATION * random.normal(size=(missing, 1, 3))
        return np.asarray(height * np.exp(-0.5 * ((S[:, None] - place) / width) ** 2))

    return _hung(count, random, bumps)


def _hung(count: int, random: np.random.Generator, variation: Callable[[int], Floats]) -> Rods:
    """Hang rods of the thesis's ranges plus a variation; for the one in 10,000 that does not hang, take another."""
    parts: list[Rods] = []
    while (missing := count - sum(map(len, parts))) > 0:
        gamma, phi0, phi1 = draw_parameters(missing, random)
        natural = np.stack([phi0, 0 * phi0, phi1], axis=1)[:, None] + variation(missing)
        solution = solve_general_rods(natural, gamma)
        good = np.flatnonzero(solution.stable)
        parts.append(Rods(gamma, natural, solution.centerline, solution.curvature)[good])
    return Rods(*(np.concatenate([getattr(part, name) for part in parts]) for name in Rods.__dataclass_fields__))


def cosines(amplitudes: Floats) -> Floats:
    """Return the part of natural curvature that varies, (n, 150, 3), of amplitudes (n, WAVES, 3) of unit deviation."""
    k = np.arange(1, WAVES + 1)
    return np.asarray(np.einsum("nki,ks->nsi", amplitudes * DEVIATION / k[:, None], np.cos(np.pi * k[:, None] * S)))
