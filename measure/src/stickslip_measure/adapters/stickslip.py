"""The adapter of stickslip's core: cloth by time steps, rods by their equilibrium."""

from typing import Any, ClassVar

import numpy as np
from stickslip_sim_core import build_info
from stickslip_sim_core.cloth.contact import SelfContact, cylinder, plane
from stickslip_sim_core.cloth.fabrics import isotropic
from stickslip_sim_core.cloth.meshes import Mesh
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.rods.solve import solve_general_rods

PRESETS = {"default": "certified", "tuned": "fine"}
FORCE_SHARE = 0.1
"""Unit of residual forces over the weight of a node, as in the protocols of the project."""


class Simulator:
    """A scene of cloth."""

    name = "stickslip"
    version = f"0.1 build {build_info().build_hash[:12]}"
    capabilities = frozenset({"held", "floor", "planes", "cylinders", "sheets", "curved", "rods"})
    settings: ClassVar = {
        "default": {"preset": "certified", "step": "20 ms", "residual": "1e-5 node weights"},
        "tuned": {"preset": "fine", "step": "10 ms", "source": "docs/cloth.md, Presets"},
    }

    def __new__(cls, scene: Any, setting: str) -> Any:
        """Return a scene of its kind."""
        return super().__new__(HungRod if hasattr(scene, "elements") else cls)

    def __init__(self, scene: Any, setting: str) -> None:
        preset = preset_named(PRESETS[setting])
        self.frame = preset.time_step
        self.damping = 0.0
        self.held = scene.start[scene.held]
        self.bodies = [body_of(body) for body in scene.bodies]
        touch = None if scene.friction is None else SelfContact(scene.friction, scene.gap)
        self.cloth = Cloth(
            Mesh(scene.rest, scene.triangles),
            isotropic(scene.density, scene.stretching, scene.bending, scene.poisson),
            preset,
            held=scene.held,
            self_contact=touch,
            force_scale=FORCE_SHARE * scene.density * scene.cell**2 * GRAVITY,
        )
        self.cloth.set_state(scene.start)
        self.set_gravity(scene.gravity)

    def step(self) -> None:
        """Advance by a frame."""
        self.cloth.step(self.frame, held=self.held, bodies=self.bodies, damping=self.damping)

    def positions(self) -> Any:
        """Return the vertices."""
        return self.cloth.positions

    def set_gravity(self, gravity: Any) -> None:
        """Change gravity."""
        self.cloth.gravity[:] = gravity

    def damp(self, rate: float) -> None:
        """Change damping."""
        self.damping = rate


class HungRod(Simulator):
    """A scene of a rod, which is at rest after its first step."""

    def __init__(self, scene: Any, setting: str) -> None:
        self.scene = scene
        self.gravity = scene.gravity
        self.frame = 1.0  # s: a rod has no time here
        self.line = np.outer(np.linspace(0.0, scene.length, scene.elements + 1), scene.clamp[:, 0])

    def step(self) -> None:
        """Solve the equilibrium, in units of the length and of the bending stiffness."""
        scene = self.scene
        weight = scene.density * -self.gravity[2] * scene.length**3 / scene.bending
        rods = solve_general_rods(
            np.array(scene.natural)[None, None] * scene.length,
            [weight],
            stiffness=(scene.twisting / scene.bending, 1.0, 1.0),
            clamp_frame=scene.clamp,
            elements=scene.elements,
            points=scene.elements + 1,
        )
        self.line = scene.length * rods.centerline[0]

    def positions(self) -> Any:
        """Return the centreline."""
        return self.line

    def set_gravity(self, gravity: Any) -> None:
        """Change gravity, which stays along z."""
        self.gravity = gravity


def body_of(body: Any) -> Any:
    """Return a body of the contract as one of the core."""
    if body.kind == "plane":
        return plane(body.friction, normal=body.direction, origin=body.point)
    # The axis of a cylinder is the last column of its rotation; the others complete the frame.
    frame = np.linalg.svd(np.array(body.direction)[None])[2][[1, 2, 0]].T
    frame[:, 0] *= np.linalg.det(frame)
    return cylinder(body.friction, body.radius, origin=body.point, rotation=frame)
