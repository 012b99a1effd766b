"""Fabrics: the table, isotropic ones, your own, and what is refused; presets by name."""

import dataclasses

import numpy as np
import pytest

from stickslip_sim_core import (
    PRESETS,
    Cloth,
    custom_fabric,
    fabric,
    fabric_names,
    isotropic,
    preset_named,
)
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.scenes import cloth_drag


def test_ten_fabrics() -> None:
    assert len(fabric_names()) == 10
    assert "gray-interlock" in fabric_names()


@pytest.mark.parametrize("name", fabric_names())
def test_fabric_is_stable(name: str) -> None:
    """Its energies are positive: a quadratic form in (G00, G11) at every strain of the table, and
    in the curvature.
    """
    cloth_fabric = fabric(name)
    assert cloth_fabric.name == name
    assert 0.05 < cloth_fabric.density < 1.0
    assert cloth_fabric.stretching.shape == (6, 4)
    k0, k1, k2, k3 = cloth_fabric.stretching.T
    assert (k0 > 0.0).all()
    assert (k2 > 0.0).all()
    assert (k3 >= 0.0).all()
    assert (k0 * k2 > k1**2).all()
    assert np.linalg.eigvalsh(cloth_fabric.rigidity)[0] > 0.0
    bending_length = (
        np.diag(cloth_fabric.rigidity)[:2].mean() / (cloth_fabric.density * 9.81)
    ) ** (1.0 / 3.0)
    assert 0.003 < bending_length < 0.05
    assert fabric(name) is cloth_fabric


def test_isotropic() -> None:
    """Pulled along one axis, free along the other, it has Young's modulus.

    Curvatures couple by Poisson's ratio.
    """
    cloth = isotropic(0.2, 100.0, 1e-5, 0.3)
    k0, k1, k2, k3 = cloth.stretching[0]
    assert k0 == k2
    assert k0 - k1**2 / k2 == pytest.approx(100.0)
    assert k3 == pytest.approx(2.0 * 100.0 / (2.0 * 1.3))  # W = 2 G (G01)^2
    assert (cloth.stretching == cloth.stretching[0]).all()
    assert cloth.rigidity[0, 1] / cloth.rigidity[0, 0] == pytest.approx(0.3)
    assert cloth.rigidity[2, 2] == pytest.approx(1e-5 * 0.35)


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
    assert set(PRESETS) == {
        "certified",
        "fast",
        "fine",
        "thesis-high",
        "thesis-low-small-dt",
        "thesis-low-big-dt",
    }
    assert all(preset_named(name).name == name for name in PRESETS)
    assert [
        PRESETS[f"thesis-{name}"].time_step for name in ("high", "low-small-dt", "low-big-dt")
    ] == [
        5e-4,
        5e-4,
        1e-3,
    ]
    with pytest.raises(dataclasses.FrozenInstanceError):
        PRESETS["fast"].time_step = 1.0  # type: ignore[misc]


class TestOwnFabric:
    TABLE = np.tile([100.0, 10.0, 80.0, 20.0], (6, 1))

    def test_table(self) -> None:
        custom = custom_fabric(
            "own", 0.2, stretching=self.TABLE, bending=(2e-5, 1e-5, 5e-6), damping=0.1
        )
        assert (custom.stretching == self.TABLE).all()
        assert (custom.rigidity == np.diag([2e-5, 1e-5, 5e-6])).all()
        assert custom.damping == 0.1
        assert (
            custom_fabric("own", 0.2, stretching=self.TABLE, bending=custom.rigidity).rigidity
            == custom.rigidity
        ).all()

    def test_young(self) -> None:
        """A plate of E, nu, h: Y = E h and D = E h^3 / (12 (1 - nu^2))."""
        custom = custom_fabric("own", 0.2, young=1e6, poisson=0.3, thickness=4e-4)
        assert custom.stretching[0, 0] == pytest.approx(1e6 * 4e-4 / (1.0 - 0.09))
        assert custom.rigidity[0, 0] == pytest.approx(1e6 * 4e-4**3 / 12.0 / (1.0 - 0.09))
        softer = custom_fabric(
            "own", 0.2, young=1e6, poisson=0.3, thickness=4e-4, bending=(1e-6, 1e-6, 4e-7)
        )
        assert softer.rigidity[0, 0] == 1e-6

    def test_scaled(self) -> None:
        base = fabric("gray-interlock")
        other = base.scaled(density=2.0, stretching=0.5, bending=3.0)
        assert other.density == 2.0 * base.density
        assert (other.stretching == 0.5 * base.stretching).all()
        assert (other.rigidity == 3.0 * base.rigidity).all()
        assert other.name == "gray-interlock, density x 2, stretching x 0.5, bending x 3"
        assert base.scaled().name == base.name

    def test_parts_of_bending_are_scaled(self) -> None:
        base = dataclasses.replace(fabric("gray-interlock"), softening=300.0)
        other = base.scaled(bending_ratio=4.0, bending_twist=3.0, softening=2.0)
        warp, weft, twist = (np.diag(other.rigidity) / np.diag(base.rigidity)).tolist()
        assert (warp, weft, twist) == pytest.approx((2.0, 0.5, 3.0))
        assert other.softening == 600.0
        assert fabric("gray-interlock").scaled(softening=2.0).softening is None

    def test_scene_takes_it(self) -> None:
        """The same numbers give the same motion, whether by name or not."""
        named = cloth_drag.scene("gray-interlock", 0.5, mesh=7, frames=4).run()
        run = cloth_drag.scene(fabric("gray-interlock").scaled(), 0.5, mesh=7, frames=4).run()
        heavy = cloth_drag.scene(
            fabric("gray-interlock").scaled(density=2.0), 0.5, mesh=7, frames=4
        ).run()
        assert run.positions.tobytes() == named.positions.tobytes()
        assert heavy.record["holder_force"][0, 2] == pytest.approx(
            2.0 * named.record["holder_force"][0, 2]
        )

    def test_damping_slows_a_fall(self) -> None:
        """By v = (g/c)(1 - exp(-c t)), to first order in the step."""
        mesh = meshes.grid(0.1, 0.1, 4, 4)
        cloth = Cloth(
            mesh,
            dataclasses.replace(fabric("gray-interlock"), damping=5.0),
            preset_named("certified"),
        )
        cloth.set_state(np.column_stack([mesh.rest, np.ones(25)]))
        for _ in range(200):
            cloth.step(1e-3)
        assert cloth.velocities[:, 2] == pytest.approx(-9.81 / 5.0 * (1.0 - np.exp(-1.0)), rel=5e-3)

    @pytest.mark.parametrize(
        ("numbers", "message"),
        [
            ({"density": 0.0}, r"density: must be in \[0.001, 100\], got 0"),
            ({"density": float("nan")}, r"density: must be in \[0.001, 100\], got nan"),
            (
                {"stretching": np.ones((5, 4))},
                r"stretching: must be \(6, 4\) numbers of 0 ... 1e\+07 N/m",
            ),
            ({"stretching": -TABLE}, r"stretching: must be \(6, 4\) numbers of 0"),
            (
                {"stretching": np.ones((6, 4))},
                r"stretching: must have k1\^2 < k0 k2 in every row, and row 0",
            ),
            (
                {"bending": (1e-5, -1e-5, 1e-5)},
                r"rigidity, an eigenvalue: must be in \[1e-12, 10\], got -1e-05",
            ),
            ({"bending": (1e-5, 1e-5)}, r"rigidity: must be a symmetric \(3, 3\)"),
            ({"bending": None}, "bending: must be given with stretching"),
            ({"damping": -1.0}, r"damping: must be in \[0, 1000\], got -1"),
            ({"young": 1e6}, "stretching, young: must be one of both, got both"),
            ({"stretching": None}, "stretching, young: must be one of both, got neither"),
            ({"stretching": None, "young": 1e6}, "thickness: must be given with young"),
            (
                {"stretching": None, "young": 1e6, "thickness": -1.0},
                r"thickness: must be in \[1e-06, 0.1\], got -1",
            ),
            (
                {"stretching": None, "young": 1e6, "thickness": 1e-3, "poisson": 0.6},
                r"poisson: must be in \[0, 0.5\]",
            ),
        ],
    )
    def test_refusals(self, numbers: dict[str, object], message: str) -> None:
        good = {
            "name": "own",
            "density": 0.2,
            "stretching": self.TABLE,
            "bending": (1e-5, 1e-5, 1e-5),
        }
        with pytest.raises(ValueError, match=message):
            custom_fabric(**{**good, **numbers})  # type: ignore[arg-type]

    def test_factors(self) -> None:
        with pytest.raises(ValueError, match="bending: must be a finite factor > 0, got 0"):
            fabric("gray-interlock").scaled(bending=0.0)
        with pytest.raises(ValueError, match="density: must be in"):
            fabric("gray-interlock").scaled(density=1e6)
