"""Cloth on cloth: a square of cloth is lowered onto a stretched cloth and dragged [thesis, 4.2.2]."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core import stage
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.bodies import plane
from stickslip_sim_core.cloth.contact import SELF_FRICTION, THICKNESS, SelfContact
from stickslip_sim_core.cloth.fabrics import Fabric, fabric_of
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import Cloth

BEHIND, LENGTH, WIDTH = 0.15, 0.6, 0.3
"""Of the stretched cloth [m]: how far behind the holders it begins, and its sides along x and y."""

STRETCH = (0.01, 0.005)
"""Its strain along each, as it is fixed all around. Equal ones would have no principal direction, from which the
stiffness is read: each triangle would take another one by rounding, and the cloth would tremble."""

FLOOR_FRICTION = 0.5
"""Of the stretched cloth with the floor below it."""


def drop_on_cloth(
    fabric: str | Fabric,
    substrate: str | Fabric,
    mu: float,
    *,
    self_friction: float = SELF_FRICTION,
    preset: str | SolverSettings = "certified",
    vertices: int = 41,
    frames: int = stage.FRAMES,
    seed: int = 0,
    kernel: str | None = None,
    on_frame: Callable[[int, int], None] | None = None,
) -> stage.DropAndDrag:
    """Lower a square of cloth onto a stretched one and drag it to and fro: see `drop_and_drag`.

    Args:
        fabric: Of the dragged cloth: one of `fabric_names()`, or a custom one.
        substrate: Of the stretched cloth, whose warp is along x; it lies on a floor.
        mu: Coefficient of friction between the two, 0 ... 10.
        self_friction: Of each with itself, 0 ... 10.
        preset: Solver settings, or their name.
        vertices: Vertices a side of both meshes, at least 5.
        frames: Frames to simulate, 2.4 a second from 0 on; 300 are the whole motion.
        seed: Of the bias.
        kernel: Level of the kernels, see `Cloth`.
        on_frame: Called with (frames done, frames) after every frame.

    Raises:
        ValueError: An argument breaks its rule.
    """
    settings = preset_named(preset)
    stage.frames_checked(frames, vertices)
    mesh = meshes.grid(stage.SIDE, stage.SIDE, vertices - 1, vertices - 1)
    held, count = stage.held_by_holders(mesh), len(mesh.rest)
    below = stretched(vertices - 1)
    cloth = Cloth(
        meshes.together(mesh, below.mesh),
        [fabric_of(fabric), fabric_of(substrate)],
        settings,
        held=np.concatenate([held, count + below.edge]),
        self_contact=SelfContact([[self_friction, mu], [mu, self_friction]], bearing="first"),
        kernel=kernel,
    )
    hung = stage.hang(mesh, cloth.fabrics[0], seed=seed, kernel=kernel)
    cloth.set_state(np.concatenate([hung.positions, below.positions]))
    floor = [plane(FLOOR_FRICTION, origin=(0.0, 0.0, -THICKNESS))]
    motion = stage.motion_of(cloth, floor, hung.positions[held], hung.tilt, below.positions[below.edge])
    return stage.run(
        cloth,
        mesh,
        hung,
        motion,
        frames=frames,
        contact_force=lambda cloth: force_on(cloth, count),
        on_frame=on_frame,
    )


@dataclass(frozen=True, eq=False)
class Stretched:
    """A cloth that is stretched over the floor and fixed all around."""

    mesh: meshes.Mesh
    edge: NDArray[np.intp]
    """Its fixed vertices."""

    positions: Floats
    """(W, 3) [m]: a thickness below z = 0, so that the cloth on it lies where it would on a floor."""


def stretched(cells: int) -> Stretched:
    """Return a cloth of so many cells a side, its warp along x, under the whole way of the dragged one."""
    mesh = meshes.grid(LENGTH / (1.0 + STRETCH[0]), WIDTH / (1.0 + STRETCH[1]), cells, cells)
    half = np.abs(mesh.rest).max(axis=0) - 1e-9
    positions = np.zeros((len(mesh.rest), 3))
    positions[:, :2] = (1.0 + np.array(STRETCH)) * mesh.rest + np.array([0.5 * LENGTH - BEHIND, 0.0])
    positions[:, 2] = -THICKNESS
    return Stretched(mesh, np.flatnonzero((np.abs(mesh.rest) > half).any(axis=1)), positions)


def force_on(cloth: Cloth, vertices: int) -> Floats:
    """Return the force of bodies and of other sheets on the first so many vertices, those that are not held [N]."""
    free = np.setdiff1d(np.arange(vertices), cloth.held)
    pairs = cloth.pair_forces
    share = (pairs.weights * (pairs.vertices < vertices)).sum(axis=1)
    force: Floats = cloth.reactions[free].sum(axis=0) + share @ pairs.forces
    return force
