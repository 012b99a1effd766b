"""Fabrics: the table, isotropic sheets, and what is refused; presets by name."""

import dataclasses

import numpy as np
import pytest

from stickslip_sim_core import PRESETS, fabric, fabric_names, isotropic, preset_named


def test_ten_fabrics() -> None:
    assert len(fabric_names()) == 10
    assert "gray-interlock" in fabric_names()


@pytest.mark.parametrize("name", fabric_names())
def test_fabric_is_stable(name: str) -> None:
    """Its energies are positive: a quadratic form in (G00, G11) at every strain of the table, and in the curvature."""
    one = fabric(name)
    assert one.name == name
    assert 0.05 < one.density < 1.0
    assert one.stretching.shape == (6, 4)
    k0, k1, k2, k3 = one.stretching.T
    assert (k0 > 0.0).all()
    assert (k2 > 0.0).all()
    assert (k3 >= 0.0).all()
    assert (k0 * k2 > k1**2).all()
    assert np.linalg.eigvalsh(one.rigidity)[0] > 0.0
    assert 0.003 < one.bending_length < 0.05
    assert fabric(name) is one


def test_isotropic() -> None:
    """Pulled along one axis, free along the other, it has Young's modulus; curvatures couple by Poisson's ratio."""
    sheet = isotropic(0.2, 100.0, 1e-5, 0.3)
    k0, k1, k2, k3 = sheet.stretching[0]
    assert k0 == k2
    assert k0 - k1**2 / k2 == pytest.approx(100.0)
    assert k3 == pytest.approx(2.0 * 100.0 / (2.0 * 1.3))  # W = 2 G (G01)^2
    assert (sheet.stretching == sheet.stretching[0]).all()
    assert sheet.rigidity[0, 1] / sheet.rigidity[0, 0] == pytest.approx(0.3)
    assert sheet.rigidity[2, 2] == pytest.approx(1e-5 * 0.35)
    assert isotropic(0.2, 1.0, 0.2 * 9.81 * 1e-6).bending_length == pytest.approx(0.01)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("field", ["density", "stretching", "rigidity"])
def test_bad_isotropic(field: str, value: float) -> None:
    numbers = {"density": 0.2, "stretching": 100.0, "rigidity": 1e-5, field: value}
    with pytest.raises(ValueError, match=f"{field}: must be finite and > 0"):
        isotropic(numbers["density"], numbers["stretching"], numbers["rigidity"])


@pytest.mark.parametrize("value", [-0.1, 0.6, float("nan")])
def test_bad_poisson(value: float) -> None:
    with pytest.raises(ValueError, match=r"poisson: must be in \[0, 0.5\]"):
        isotropic(0.2, 100.0, 1e-5, value)


def test_unknown_names() -> None:
    with pytest.raises(ValueError, match=r"fabric: must be one of .*gray-interlock.*, got 'silk'"):
        fabric("silk")
    with pytest.raises(ValueError, match=r"preset: must be one of certified, .* got 'best'"):
        preset_named("best")


def test_presets() -> None:
    assert set(PRESETS) == {"certified", "fast", "thesis-high", "thesis-low-small-dt", "thesis-low-big-dt"}
    assert all(preset_named(name).name == name for name in PRESETS)
    assert [PRESETS[f"thesis-{name}"].time_step for name in ("high", "low-small-dt", "low-big-dt")] == [
        5e-4,
        5e-4,
        1e-3,
    ]
    with pytest.raises(dataclasses.FrozenInstanceError):
        PRESETS["fast"].time_step = 1.0  # type: ignore[misc]
