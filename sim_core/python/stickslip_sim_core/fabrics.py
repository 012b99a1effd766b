"""What cloth is made of: density, stiffness against stretching and against bending."""

import tomllib
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fabric:
    """Constitutive numbers of a sheet; the first axis of its rest plane is the warp."""

    name: str
    density: float
    """Mass per area [kg/m^2]."""

    stretching: Floats
    """(6, 4) [N/m]: k0 ... k3 of the energy per area k0 G00^2/2 + k1 G00 G11 + k2 G11^2/2 + k3 G01^2, G being Green's
    strain. Row 0 holds at no strain, rows 1 ... 5 where the larger principal stretch is 1 + 1/6, at 0, 22.5, ..., 90
    degrees from the warp; bilinear in between."""

    rigidity: Floats
    """(3, 3) [N m]: D of the energy per area H:D:H/2, H = (H11, H22, 2 H12) being the second derivatives."""

    @property
    def bending_length(self) -> float:
        """Gravito-bending length (D / (rho g))^(1/3) [m] with the mean of both directions, g = 9.81 m/s^2."""
        return float((0.5 * (self.rigidity[0, 0] + self.rigidity[1, 1]) / (self.density * 9.81)) ** (1.0 / 3.0))


def isotropic(density: float, stretching: float, rigidity: float, poisson: float = 0.0, name: str = "sheet") -> Fabric:
    """Return an isotropic sheet.

    Args:
        density: Mass per area [kg/m^2].
        stretching: Y, Young's modulus times thickness [N/m].
        rigidity: D of plates, E h^3 / (12 (1 - poisson^2)) [N m].
        poisson: Poisson's ratio, in [0, 0.5].

    Raises:
        ValueError: A number breaks its rule.
    """
    for field, value in (("density", density), ("stretching", stretching), ("rigidity", rigidity)):
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"{field}: must be finite and > 0, got {value}")
    if not 0.0 <= poisson <= 0.5:
        raise ValueError(f"poisson: must be in [0, 0.5], got {poisson}")
    tension = stretching / (1.0 - poisson**2)
    row = [tension, poisson * tension, tension, stretching / (1.0 + poisson)]
    plate = rigidity * np.array([[1.0, poisson, 0.0], [poisson, 1.0, 0.0], [0.0, 0.0, 0.5 * (1.0 - poisson)]])
    return Fabric(name, float(density), np.tile(row, (6, 1)), plate)


@lru_cache
def fabric(name: str) -> Fabric:
    """Return one of the fabrics of [Wang et al. 2011].

    Its stretching numbers are doubled, as the authors' simulator does, negative ones are raised to 0, and the coupling
    is kept positive definite. Its bending numbers k are coefficients of hinges: a plate as stiff has D = k/4 on
    equilateral triangles. D against curvature along warp, weft and in between comes from hinges across it; with no
    coupling D12, D66 = D(45 degrees) - (D11 + D22)/4. D is the mean over the tabulated curvatures.

    Raises:
        ValueError: There is no such fabric.
    """
    table = _table()
    if name not in table:
        raise ValueError(f"fabric: must be one of {', '.join(table)}, got {name!r}")
    facts = table[name]
    k = 2.0 * np.maximum(np.array(facts["stretching"]), 0.0)
    k[:, 1] = np.minimum(k[:, 1], 0.95 * np.sqrt(k[:, 0] * k[:, 2]))
    across_weft, between, across_warp = np.mean(facts["bending"], axis=1) / 4.0
    twist = max(between - 0.25 * (across_weft + across_warp), 0.1 * min(across_weft, across_warp))
    return Fabric(name, float(facts["density"]), k, np.diag([across_warp, across_weft, twist]))


def fabric_names() -> tuple[str, ...]:
    """Return the names that `fabric` knows."""
    return tuple(_table())


@lru_cache
def _table() -> dict[str, dict[str, Any]]:
    text = files("stickslip_sim_core").joinpath("fabrics.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)
