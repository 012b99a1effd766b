"""Shared rods: a seeded sample over the thesis's ranges, solved once."""

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import RodSolution, solve_rods

Floats = NDArray[np.float64]


@pytest.fixture(scope="session")
def thesis_rods() -> Floats:
    """400 rods over the thesis's ranges and 200 in the corner with several minima.

    Rows (gamma, phi0, phi1).
    """
    rng = np.random.default_rng(20260101)
    ranges = rng.uniform([100, 0.2, 6], [1300, 12, 20], (400, 3))
    corner = rng.uniform([100, 0.2, 9.1], [1300, 2.8, 20], (200, 3))
    return np.concatenate([ranges, corner])


@pytest.fixture(scope="session")
def solved(thesis_rods: Floats) -> RodSolution:
    """The sample with the default settings."""
    return solve_rods(*thesis_rods.T)


@pytest.fixture(scope="session")
def refined(thesis_rods: Floats) -> RodSolution:
    """The sample with 8 times the elements, whose error is 8^-6 times smaller."""
    return solve_rods(*thesis_rods.T, elements=1024)
