"""The adapter of PyElastica: a Cosserat rod by explicit time steps."""

from importlib.metadata import version
from typing import Any, ClassVar

import elastica
import numpy as np

SLENDER = 0.01  # radius over length
STABLE = 0.3  # time step over the shortest period of an element
FRAME = 0.01  # s


class Rods(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing):
    """One rod, its clamp, and gravity."""


class Gravity(elastica.NoForces):
    """The weight of a rod under an acceleration (3,), an array that may change."""

    def __init__(self, acceleration: Any) -> None:
        super().__init__()
        self.acceleration = acceleration

    def apply_forces(self, system: Any, time: Any = 0.0) -> None:
        """Add the weight."""
        system.external_forces += self.acceleration[:, None] * system.mass


class Simulator:
    """A rod whose first point and first element are clamped."""

    name = "pyelastica"
    version = version("pyelastica")
    capabilities = frozenset({"rods"})
    settings: ClassVar = {
        "default": {
            "radius": "0.01 lengths, with the moduli that give EI and GJ",
            "clamp": "OneEndFixedBC",
            "step": "0.3 of the shortest period of an element",
            "damping": "none, but while a scene settles",
        }
    }
    frame = FRAME
    rate = 0.0

    def __init__(self, scene: Any, setting: str) -> None:
        radius = SLENDER * scene.length
        section = np.pi * radius**2
        young = scene.bending / (0.25 * section * radius**2)
        shear = scene.twisting / (0.5 * section * radius**2)
        density = scene.density / section
        tangent, normal, _ = scene.clamp.T
        # PyElastica has the tangent as its third director, after normal and binormal.
        self.rod = elastica.CosseratRod.straight_rod(
            scene.elements,
            start=np.zeros(3),
            direction=tangent,
            normal=normal,
            base_length=scene.length,
            base_radius=radius,
            density=density,
            youngs_modulus=young,
            shear_modulus=shear,
        )
        twist, first, second = scene.natural
        self.rod.rest_kappa[:] = np.array([first, second, twist])[:, None]
        self.gravity = np.array(scene.gravity)
        self.rods = Rods()
        self.rods.append(self.rod)
        ends = {"constrained_position_idx": (0,), "constrained_director_idx": (0,)}
        self.rods.constrain(self.rod).using(elastica.OneEndFixedBC, **ends)
        self.rods.add_forcing_to(self.rod).using(Gravity, self.gravity)
        self.rods.finalize()
        element = scene.length / scene.elements
        sound = np.sqrt(young / density)
        turning = radius / np.sqrt(shear / density)
        periods = (element / sound, 0.4 * element**2 / (radius * sound), turning)
        self.substeps = int(np.ceil(FRAME / (STABLE * min(periods))))
        self.stepper = elastica.PositionVerlet()
        self.time = np.float64(0.0)

    def step(self) -> None:
        """Advance by a frame."""
        for _ in range(self.substeps):
            self.time = self.stepper.step(self.rods, self.time, FRAME / self.substeps)
        decay = np.exp(-self.rate * FRAME)
        self.rod.velocity_collection *= decay
        self.rod.omega_collection *= decay

    def positions(self) -> Any:
        """Return the points."""
        return self.rod.position_collection.T

    def set_gravity(self, gravity: Any) -> None:
        """Change gravity."""
        self.gravity[:] = gravity

    def damp(self, rate: float) -> None:
        """Change the decay of velocities."""
        self.rate = rate
