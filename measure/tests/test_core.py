"""Every experiment has the same bits on the core by its adapter and on the core in this process.

The second run has `Cloth` and the solver of rods, and neither adapter nor messages nor host. The
protocols of slopes, which use the verbs of an adapter alone, run in test_process.py. The others ask
for reactions, moving holders and jaws, step control or stiffness matrices, which no adapter has.
"""

from pathlib import Path

import numpy as np
import pytest
from stickslip_measure import adapters, experiments
from stickslip_measure.contract import Body, Floats, Rod, Sheet
from stickslip_measure.laboratory import Laboratory
from stickslip_measure.process import Program, Simulation, describe
from stickslip_sim_core.cloth import contact
from stickslip_sim_core.cloth.fabrics import isotropic
from stickslip_sim_core.cloth.meshes import Mesh
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.rods.solve import solve_general_rods

STICKSLIP = Program(Path(adapters.__file__).with_name("stickslip.py"))


class DirectCloth(Simulation):
    """A scene of cloth in this process, as protocols make it."""

    def __init__(self, laboratory: Laboratory, scene: Sheet) -> None:
        preset = preset_named("certified")
        between = None
        if scene.friction is not None:
            between = contact.SelfContact(scene.friction, scene.gap)
        self.scene = scene
        self.adapter = laboratory.description
        self.frame = preset.time_step
        self.time = 0.0
        self.damping = None
        self.bodies = [direct_body(body) for body in scene.bodies]
        self.cloth = Cloth(
            Mesh(scene.rest, scene.triangles),
            isotropic(scene.density, scene.stretching, scene.bending, scene.poisson),
            preset,
            held=scene.held,
            self_contact=between,
            force_scale=0.1 * scene.density * scene.cell**2 * GRAVITY,
        )
        self.cloth.set_state(scene.start)
        self.held = scene.start[scene.held]
        self.positions = scene.start

    def advance(self, gravity: Floats) -> Floats:
        frames = []
        for pull in gravity:
            self.cloth.gravity[:] = pull
            self.cloth.step(
                self.frame,
                held=self.held,
                bodies=self.bodies,
                damping=self.damping or 0.0,
            )
            frames.append(self.cloth.positions)
        self.positions = frames[-1]
        return np.stack(frames)


def direct_body(body: Body) -> contact.Body:
    """Return a body of the core. All cylinders of the experiments lie along y."""
    if body.kind == "plane":
        return contact.plane(body.friction, normal=body.direction, origin=body.point)
    assert body.direction == (0.0, 1.0, 0.0)
    along_y = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    return contact.cylinder(body.friction, body.radius, origin=body.point, rotation=along_y)


class DirectRod(Simulation):
    """A scene of a rod in this process: its equilibrium."""

    def __init__(self, laboratory: Laboratory, scene: Rod) -> None:
        self.scene = scene
        self.adapter = laboratory.description
        self.frame = 1.0
        self.time = 0.0
        self.damping = None
        self.positions = np.zeros((scene.elements + 1, 3))

    def advance(self, gravity: Floats) -> Floats:
        rod = self.scene
        assert isinstance(rod, Rod)
        shape = solve_general_rods(
            np.array(rod.natural)[None, None] * rod.length,
            [rod.density * -gravity[0, 2] * rod.length**3 / rod.bending],
            stiffness=(rod.twisting / rod.bending, 1.0, 1.0),
            clamp_frame=rod.clamp,
            elements=rod.elements,
            points=rod.elements + 1,
        )
        self.positions = rod.length * shape.centerline[0]
        return np.stack([self.positions] * len(gravity))


class DirectLaboratory(Laboratory):
    """Opens scenes in this process."""

    def open(self, scene: Sheet | Rod) -> Simulation:
        if isinstance(scene, Rod):
            return DirectRod(self, scene)
        return DirectCloth(self, scene)


@pytest.mark.physics
@pytest.mark.parametrize("name", [*experiments.CHECKS, *experiments.EXPERIMENTS])
def test_an_experiment_has_the_same_bits_by_the_adapter(name: str, tmp_path: Path) -> None:
    log = tmp_path / "log"
    experiment = {**experiments.CHECKS, **experiments.EXPERIMENTS}[name]
    description = describe(STICKSLIP, log, 60.0)
    with Laboratory(STICKSLIP, description, "default", log, 120.0) as laboratory:
        remote = experiment.measure(laboratory, experiment.cells[0])
    direct_laboratory = DirectLaboratory(STICKSLIP, description, "default", log, 120.0)
    direct = experiment.measure(direct_laboratory, experiment.cells[0])
    assert remote.value == direct.value
    assert remote.details == direct.details
    np.testing.assert_array_equal(remote.measured, direct.measured)
