"""Small scenes in which cloth touches bodies, surfaces or itself, a few CPU seconds in all.

The golden tests record what they end with, and the sweeps in the comments of the solver's constants
(`contact/constants.hpp`) are measured on them.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Body, SelfContact, Surface, box, plane, sphere
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth

from stickslip_testing.spheres import icosphere
from stickslip_testing.tumbles import STEP, Tumble, crumple, folding, pile, squeeze

FABRIC = "gray-interlock"


def _steps(tumble: Tumble, steps: int) -> Cloth:
    for step in range(1, steps + 1):
        tumble.cloth.step(STEP, held=tumble.held(step * STEP), bodies=tumble.bodies)
    return tumble.cloth


def ball(preset: SolverSettings) -> Cloth:
    """A sheet falls onto a coarse sphere of triangles, which turns, and hangs down to a floor."""
    directions, triangles = icosphere(1)

    def at(time: float) -> Floats:
        c, s = np.cos(2.0 * time), np.sin(2.0 * time)
        turned: Floats = 0.03 * directions @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return turned

    mesh = meshes.unstructured(0.08, 0.08, 0.01, 5)
    surfaces = [Surface(triangles, at, 0.5)]
    cloth = Cloth(mesh, fabric(FABRIC), preset, self_contact=SelfContact(0.4), surfaces=surfaces)
    cloth.set_state(np.column_stack([mesh.rest, np.full(len(mesh.rest), 0.032)]))
    for _ in range(25):
        cloth.step(STEP, bodies=[plane(0.4, origin=(0.0, 0.0, -0.032))])
    return cloth


def edges(preset: SolverSettings) -> Cloth:
    """A sheet falls onto a ball and the edges of a box, both small against its cells."""
    mesh = meshes.unstructured(0.08, 0.08, 0.01, 5)
    cloth = Cloth(mesh, fabric(FABRIC), preset)
    cloth.set_state(np.column_stack([mesh.rest, np.full(len(mesh.rest), 0.002)]))
    ball = sphere(0.5, 0.012, origin=(-0.02, 0.003, -0.012))
    block = box(0.5, (0.03, 0.03, 0.03), rounding=0.01, origin=(0.022, 0.0, -0.015))
    for _ in range(15):
        cloth.step(STEP, bodies=[ball, block])
    return cloth


def valley(preset: SolverSettings) -> Cloth:
    """A sheet falls into a valley of two planes, in whose corner vertices bear on both."""
    mesh = meshes.grid(0.08, 0.08, 8, 8)
    cloth = Cloth(mesh, fabric(FABRIC), preset)
    cloth.set_state(np.column_stack([mesh.rest, np.full(len(mesh.rest), 0.045)]))
    for _ in range(25):
        cloth.step(STEP, bodies=[plane(0.2, normal=(x, 0.0, 1.0)) for x in (1.0, -1.0)])
    return cloth


def strip(preset: SolverSettings) -> Cloth:
    """A wavy strip is pushed and pulled over a floor by its end.

    The controller chooses the steps.
    """
    mesh = meshes.grid(0.02, 0.12, 3, 16)
    held = np.flatnonzero(mesh.rest[:, 1] > 0.06 - 1e-9)
    cloth = Cloth(mesh, fabric(FABRIC), preset, held=held, self_contact=SelfContact(0.5))
    start = np.column_stack([mesh.rest, 0.004 + 0.003 * np.sin(120.0 * mesh.rest[:, 1])])
    cloth.set_state(start)
    gravity = np.tile([0.0, 0.0, -GRAVITY], (len(mesh.rest), 1))

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        along = 0.06 * (1.0 - np.cos(6.0 * time))
        down = 0.002 * min(time / 0.1, 1.0)
        return gravity, start[held] - np.array([0.0, along, down]), [plane(0.6)]

    cloth.advance(2.5, motion, event=2.5)
    return cloth


def controlled(tumble: Tumble, end: float) -> Cloth:
    """A tumble until a time [s], by steps of the controller's choice."""
    gravity = np.tile([0.0, 0.0, -GRAVITY], (len(tumble.cloth.positions), 1))
    tumble.cloth.advance(end, lambda time: (gravity, tumble.held(time), tumble.bodies), event=end)
    return tumble.cloth


SCENES: Mapping[str, Callable[[SolverSettings], Cloth]] = MappingProxyType(
    {
        "pile": lambda preset: _steps(pile(2, preset, sheets=3), 22),
        "fold": lambda preset: _steps(folding(9, preset), 100),
        "crumple": lambda preset: _steps(crumple(1, preset), 14),
        "squeeze": lambda preset: _steps(squeeze(1, preset), 9),
        "ball": ball,
        "strip": strip,
        "edges": edges,
        "valley": valley,
        "push": lambda preset: controlled(crumple(1, preset), 0.15),
        "let down": lambda preset: controlled(folding(9, preset), 1.0),
    }
)
"""Three sheets that fall onto each other, a strip that folds, a sheet that is crumpled by walls,
one that is squeezed within its plane, one on a ball, one that slides, one on edges, one in a
valley; the crumple and the fold by steps of the controller's choice."""
