"""The adapter of PyBullet: a sheet is a soft body of springs along edges and across them."""

import tempfile
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np
import pybullet

MARGIN = 1e-3  # m
FRAME = 1.0 / 240.0  # s, the default step
SPRINGS = 8  # at an inner vertex, without those across edges
DAMPING = {"default": 0.1, "tuned": 0.0}  # of springs; Bullet has 0.1 by default
CHOICES = {
    "springs": "Y along edges, D / cell^2 across them; steps explicit in them; margin 1 mm",
    "bending": "springs across edges do not resist the bending of a flat sheet to first order",
}
THICK = 1.0  # of a box that stands for a plane [m]
WIDE = 20.0  # m


class Simulator:
    """A sheet of cloth."""

    name = "pybullet"
    version = version("pybullet")
    capabilities = frozenset({"held", "floor", "planes", "cylinders"})
    clearance = MARGIN
    settings: ClassVar = {
        "default": {"step": "1/240 s", "springDampingStiffness": 0.1, "sleeping": "on", **CHOICES},
        "tuned": {
            "step": "1/240 s over the power of 2 for which explicit springs are stable",
            "springDampingStiffness": 0.0,
            "sleeping": "off",
            **CHOICES,
            "source": "PyBullet Quickstart Guide: setTimeStep, loadSoftBody, changeDynamics",
        },
    }
    frame = FRAME

    def __init__(self, scene: Any, setting: str) -> None:
        pybullet.connect(pybullet.DIRECT)
        pybullet.resetSimulation(pybullet.RESET_USE_DEFORMABLE_WORLD)
        self.substeps = substeps(scene) if setting == "tuned" else 1
        pybullet.setTimeStep(FRAME / self.substeps)
        self.set_gravity(scene.gravity)
        for body in scene.bodies:
            add_body(body)
        self.cloth = pybullet.loadSoftBody(
            written(scene),
            mass=scene.masses().sum(),
            useMassSpring=1,
            useBendingSprings=1,
            springElasticStiffness=scene.stretching,
            springDampingStiffness=DAMPING[setting],
            springDampingAllDirections=1,
            springBendingStiffness=scene.bending / scene.cell**2,
            useFaceContact=1,
            # A contact has the product of both frictions, and bodies have 1.
            frictionCoeff=max([body.friction for body in scene.bodies], default=0.0),
            collisionMargin=MARGIN,
        )
        if setting == "tuned":
            awake = pybullet.ACTIVATION_STATE_DISABLE_SLEEPING
            pybullet.changeDynamics(self.cloth, -1, activationState=awake)
        # The soft body has another order of vertices.
        distances = np.linalg.norm(self.vertices()[None] - scene.start[:, None], axis=2)
        self.order = distances.argmin(axis=1)
        for vertex in self.order[scene.held]:
            pybullet.createSoftBodyAnchor(self.cloth, int(vertex), -1, -1)

    def vertices(self) -> Any:
        """Return the vertices in the order of the soft body."""
        flags = pybullet.MESH_DATA_SIMULATION_MESH
        return np.array(pybullet.getMeshData(self.cloth, -1, flags=flags)[1])

    def step(self) -> None:
        """Advance by a frame."""
        for _ in range(self.substeps):
            pybullet.stepSimulation()

    def positions(self) -> Any:
        """Return the vertices."""
        return self.vertices()[self.order]

    def set_gravity(self, gravity: Any) -> None:
        """Change gravity."""
        pybullet.setGravity(*(float(value) for value in gravity))


def substeps(scene: Any) -> int:
    """Return the steps of a frame, each below 2 over the highest frequency of springs."""
    frequency = np.sqrt(2.0 * SPRINGS * scene.stretching / scene.masses().mean())
    return int(2 ** np.ceil(np.log2(0.5 * FRAME * frequency)))


def add_body(body: Any) -> None:
    """Add a body of friction 1. A plane is the upper face of a box, which Bullet turns."""
    axis = np.array(body.direction)
    place = np.array(body.point)
    if body.kind == "plane":
        sides = [WIDE, WIDE, 0.5 * THICK]
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=sides)
        place = place - 0.5 * THICK * axis
    else:
        kind = pybullet.GEOM_CYLINDER
        shape = pybullet.createCollisionShape(kind, radius=body.radius, height=1.0)
    # The quaternion that turns z to the axis, by the half angle.
    turn = np.append(np.cross([0.0, 0.0, 1.0], axis), 1.0 + axis[2])
    number = pybullet.createMultiBody(0.0, shape, -1, place, turn / np.linalg.norm(turn))
    pybullet.changeDynamics(number, -1, lateralFriction=1.0)


def written(scene: Any) -> str:
    """Write the sheet into an OBJ file, and return its path."""
    with tempfile.NamedTemporaryFile("w", suffix=".obj", delete=False) as file:
        np.savetxt(file, scene.start, "v %.9f %.9f %.9f")
        np.savetxt(file, scene.triangles + 1, "f %d %d %d")
    return file.name
