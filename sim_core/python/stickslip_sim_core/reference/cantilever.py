"""Master curve of a strip or a rod that is clamped horizontally and hangs under its own weight."""

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.reference.boundary_values import (
    NotSolvedError,
    positive,
    solve_boundary_values,
)


def cantilever(gamma: ArrayLike) -> Floats:
    """Return H/W of a heavy elastica clamped horizontally.

    H is the drop of its tip, W its horizontal reach.

    With psi the angle from the downward vertical to the tangent and primes d/ds,

        psi'' = gamma (1 - s) sin psi,   psi(0) = pi/2,   psi'(1) = 0,
        H = int cos psi ds,   W = int sin psi ds.

    The curve takes the solution with 0 < psi <= pi/2. The energy is convex in this range, so the
    solution is unique.

    Args:
        gamma: Weight against bending, rho A g L^3 / EI [-], > 0, any shape.

    Raises:
        ValueError: A gamma is not positive and finite.
    """
    values = positive("gamma", gamma)
    return np.array([_cantilever(float(g)) for g in values.ravel()]).reshape(values.shape)


def _cantilever(gamma: float) -> float:
    # Heavy strips bend in thin layers at the clamp and at the free end, so the mesh is fine there.
    # The fields are psi, psi' / rate, and H and W, both scaled.
    rate = max(1.0, np.sqrt(gamma))
    clamp = 1.0 / rate
    tip = min(1.0, gamma ** (-1.0 / 3.0))
    mesh = np.unique(
        np.concatenate(
            [np.geomspace(0.25 * clamp, 0.5, 16), 1.0 - tip * np.linspace(0.0, 0.5, 5), [0.0]]
        )
    )

    # A light strip drops in proportion to gamma. Scaling keeps the digits of the drop.
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

    # The guess falls from the clamp like the linear solution of a heavy strip.
    hanging = np.pi / 2.0 * np.exp(-mesh * np.sqrt(gamma))
    solution = solve_boundary_values(
        change, ends, mesh, np.stack([hanging, -hanging * np.sqrt(gamma) / rate, mesh, mesh])
    )
    psi, _, drop, reach = solution.y
    if psi.min() < -1e-9 or psi.max() > np.pi / 2.0 + 1e-9:
        raise NotSolvedError(f"cantilever: the solution at gamma = {gamma} is not the hanging one")
    return float(light * rate * drop[-1] / reach[-1])
