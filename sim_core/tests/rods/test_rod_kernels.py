"""A rod's bits depend on nothing but its own numbers and the settings."""

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import RodSolution, _sim_core, solve_rods

Floats = NDArray[np.float64]

FIELDS = (
    "centerline",
    "curvature",
    "frame",
    "energy",
    "stable",
    "converged",
    "iterations",
    "residual",
    "refinement",
)


def solve_on(kernel: str, rods: Floats, elements: int) -> RodSolution:
    gamma, phi0, phi1 = np.ascontiguousarray(rods.T)
    return RodSolution(
        *_sim_core.solve_rods(gamma, phi0, phi1, 1 / 1.5, elements, 150, kernel=kernel)
    )


def assert_same_bits(
    a: RodSolution, b: RodSolution, of_a: slice | NDArray[np.int64] = slice(None)
) -> None:
    for name in FIELDS:
        assert (
            np.ascontiguousarray(getattr(a, name)[of_a]).tobytes() == getattr(b, name).tobytes()
        ), name


@pytest.fixture(params=[48, 128])
def elements(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture
def rods(thesis_rods: Floats, elements: int) -> Floats:
    """A mix with easy neighbours, rods that need a second start, and one that fails."""
    fails = [1e8, 0.1, 2.4 * elements / 4]
    extremes = [[0.0, 0.0, 0.0], fails, [0.0, 12.0, 20.0], [3000.0, 0.1, 29.0], [500.0, 0.0, 12.0]]
    return np.concatenate([thesis_rods[395:428], extremes, thesis_rods[:3]])


def test_alone_as_in_company(rods: Floats, elements: int) -> None:
    together = solve_rods(*rods.T, elements=elements)
    for i in range(len(rods)):
        assert_same_bits(
            together, solve_rods(*rods[i : i + 1].T, elements=elements), slice(i, i + 1)
        )


def test_any_order(rods: Floats, elements: int) -> None:
    order = np.random.default_rng(0).permutation(len(rods))
    assert_same_bits(
        solve_rods(*rods.T, elements=elements), solve_rods(*rods[order].T, elements=elements), order
    )


def test_twice(rods: Floats, elements: int) -> None:
    assert_same_bits(solve_rods(*rods.T, elements=elements), solve_rods(*rods.T, elements=elements))


def test_every_kernel(rods: Floats, elements: int) -> None:
    reference = solve_on("baseline", rods, elements)
    assert (~reference.converged).sum() == 1
    for kernel in _sim_core.kernels():
        assert_same_bits(reference, solve_on(kernel, rods, elements))


def test_unknown_kernel_is_refused(thesis_rods: Floats) -> None:
    with pytest.raises(ValueError, match=r"kernel: .* got 'abacus'"):
        solve_on("abacus", thesis_rods, 128)
