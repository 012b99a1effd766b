"""Strips that soften: their master curve, and the protocol."""

import numpy as np
import pytest

from stickslip_sim_core import protocols
from stickslip_sim_core.protocols.soft_cantilever import SoftCantilever
from stickslip_sim_core.reference import master_curves
from stickslip_sim_core.reference.soft_cantilever import soft_cantilever


@pytest.mark.parametrize("gamma", [1.0, 10.0, 100.0])
def test_master_without_softening_is_that_of_the_cantilever(gamma: float) -> None:
    plain = float(master_curves.cantilever(gamma))
    assert soft_cantilever(gamma, 1e9) == pytest.approx(plain, rel=1e-7)


def test_master_of_light_strips_has_the_first_order_of_softening() -> None:
    """With k = M + M^2/k_s and M = gamma t^2/2, the tip drops by gamma/8 + gamma^2/(24 k_s)."""
    gamma, softening = 1e-2, 0.1
    expected = gamma / 8.0 + gamma**2 / (24.0 * softening)
    # The next order is 2 M^2/k_s^2 of the curvature, 1 % here.
    assert soft_cantilever(gamma, softening) == pytest.approx(expected, rel=2e-2)
    assert soft_cantilever(gamma, softening) > gamma / 8.0


def test_master_goes_on_beyond_the_corner_of_its_law() -> None:
    """Half of the rigidity everywhere is a bound, which soft and heavy strips come near."""
    soft = [soft_cantilever(10.0, softening) for softening in (50.0, 16.0, 4.0, 0.01)]
    assert np.all(np.diff(soft) > 0.0)
    assert soft[-1] == pytest.approx(float(master_curves.cantilever(20.0)), rel=1e-3)


@pytest.mark.physics
def test_protocol_measures_softening() -> None:
    cells = (10, 20, 40)
    result = protocols.run(
        "soft-cantilever", softening=(16.0,), gamma=(10.0,), cells=cells, unstructured=0
    )
    (curve,) = result.curves
    assert curve.measured[0] == pytest.approx(curve.master[0], rel=2e-3)
    # A strip of constant rigidity hangs by 15 % less.
    assert curve.master[0] > 1.15 * float(master_curves.cantilever(10.0))
    assert set(SoftCantilever.parameters) == {"softening", "mesh"}
