"""Capstan: the pull that draws a strip over a cylinder, T2 = T1 exp(mu wrap)."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from stickslip_sim_core.arrays import check_range
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import cylinder
from stickslip_sim_core.cloth.fabrics import Fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.protocols.capstan import RADIUS, Strip


@dataclass(frozen=True)
class CapstanPull:
    """The result of a pull over a cylinder."""

    fabric: str
    mu: float
    """Coefficient of friction that the strip was simulated with."""

    light: float
    """Pull at the free end [N/m]."""

    heavy: float
    """Mean pull that draws the strip [N/m]."""

    wrap: float
    """Angle between the two pulls [rad]."""

    @property
    def read_mu(self) -> float:
        """Coefficient of friction that the pulls read, without a stiffness of the strip."""
        return float(np.log(self.heavy / self.light)) / self.wrap


class _FabricStrip(Strip):
    """A strip of a fabric, which a light pull keeps from stretching much."""

    light_pull: ClassVar[float] = 0.2

    def __init__(self, fabric: Fabric, mu: float) -> None:
        self.fabric = fabric
        # Numbers of the material that the protocol would make have no use here.
        super().__init__(mu, 1.0, preset_named("certified"))

    def over(self, mu: float, mesh: meshes.Mesh, _material: Fabric, force_scale: float) -> Cloth:
        self.bodies = [cylinder(mu, RADIUS, rotation=[[1, 0, 0], [0, 0, 1], [0, -1, 0]])]
        return Cloth(mesh, self.fabric, self.preset, held=self.held, force_scale=force_scale)


def pull(fabric: Fabric, mu: float) -> CapstanPull:
    """Draw a strip over a cylinder of radius 5 cm against a light pull, along the warp.

    Raises:
        ValueError: mu is not from 0.01 to 1.5.
    """
    check_range("mu", mu, 0.01, 1.5)
    strip = _FabricStrip(fabric, mu)
    heavy, wrap = strip.draw()
    return CapstanPull(fabric.name, mu, strip.light_pull, float(heavy.mean()), wrap)
