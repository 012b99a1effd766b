"""Cloth on cloth: a square of cloth is lowered onto a stretched cloth and dragged [thesis, 4.2.2]."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.bodies import plane
from stickslip_sim_core.cloth.contact import SELF_FRICTION, THICKNESS, SelfContact
from stickslip_sim_core.cloth.fabrics import Fabric, fabric_of
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.scenes.cloth_drag import (
    FRAME_RATE,
    FRAMES,
    checked_square,
    dragged_forces,
    drop_labels,
    hang,
    holder_pose,
    motion_of,
)
from stickslip_sim_core.scenes.holders import Holder
from stickslip_sim_core.scenes.scene import Scene, cloth_kind

BEHIND, LENGTH, WIDTH = 0.15, 0.6, 0.3
"""Of the stretched cloth [m]: how far behind the holders it begins, and its sides along x and y."""

STRETCH = (0.01, 0.005)
"""Its strain along each axis. The stiffness depends on the principal direction, which equal strains do not have: each
triangle would take another one by rounding, and the cloth would tremble."""

FLOOR_FRICTION = 0.5
"""Of the stretched cloth with the floor below it."""


def scene(
    material: str | Fabric,
    substrate_material: str | Fabric,
    mu: float,
    *,
    self_friction: float = SELF_FRICTION,
    preset: str | SolverSettings = "certified",
    mesh: int = 41,
    frames: int = FRAMES,
    seed: int = 0,
    kernel: str | None = None,
) -> Scene:
    """Return the scene of a square of cloth that is lowered onto a stretched one and dragged to and fro.

    Args:
        material: Of the dragged cloth: one of `fabric_names()`, or a fabric.
        substrate_material: Of the stretched cloth, whose warp is along x; it lies on a floor.
        mu: Coefficient of friction between the two, 0 ... 10.
        self_friction: Of each with itself, 0 ... 10.
        preset: Solver settings, or their name.
        mesh: Vertices a side of both grids, at least 5.
        frames: Frames, 2.4 a second from 0 on; 300 are the whole motion.
        seed: Of the bias.
        kernel: Level of the kernels, see `Cloth`.

    Raises:
        ValueError: An argument breaks its rule.
    """
    square = checked_square(mesh, frames)
    hung = hang(square, fabric_of(material), seed=seed, kernel=kernel)
    below, count = stretched(mesh - 1), len(square.rest)
    floor = [plane(FLOOR_FRICTION, origin=(0.0, 0.0, -THICKNESS))]
    everything = meshes.together(square, below.mesh)
    return Scene(
        mesh=everything,
        sheet=square,
        fabrics=[fabric_of(material), fabric_of(substrate_material)],
        preset=preset_named(preset),
        start=np.concatenate([hung.positions, below.positions]),
        holders=[Holder(hung.held, holder_pose), Holder(count + below.edge, lambda _time: np.eye(3, 4))],
        motion=motion_of(hung, len(everything.rest), floor),
        self_contact=SelfContact([[self_friction, mu], [mu, self_friction]], bearing="first"),
        frames=frames,
        frame_rate=FRAME_RATE,
        forces=lambda cloth: dragged_forces(cloth, hung, force_on(cloth, count)),
        tracks={"holder_pose": holder_pose},
        labels=lambda run: {**drop_labels(run, hung), "least_distance": float(run.least_distance)},
        kernel=kernel,
        reason=hung.reason,
    )


KIND = cloth_kind(scene)


@dataclass(frozen=True, eq=False)
class Stretched:
    """A cloth that is stretched over the floor and fixed all around."""

    mesh: meshes.Mesh
    edge: NDArray[np.intp]
    """Its fixed vertices."""

    positions: Floats
    """(W, 3) [m]: a thickness below z = 0, so that the cloth on it lies where it would on a floor."""


def stretched(cells: int) -> Stretched:
    """Return a cloth of `cells` a side, its warp along x, under the whole way of the dragged one."""
    mesh = meshes.grid(LENGTH / (1.0 + STRETCH[0]), WIDTH / (1.0 + STRETCH[1]), cells, cells)
    half = np.abs(mesh.rest).max(axis=0) - 1e-9
    positions = np.zeros((len(mesh.rest), 3))
    positions[:, :2] = (1.0 + np.array(STRETCH)) * mesh.rest + np.array([0.5 * LENGTH - BEHIND, 0.0])
    positions[:, 2] = -THICKNESS
    return Stretched(mesh, np.flatnonzero((np.abs(mesh.rest) > half).any(axis=1)), positions)


def force_on(cloth: Cloth, vertices: int) -> Floats:
    """Return the force of bodies and other sheets on those of the first `vertices` that are not held (3,) [N]."""
    free = np.setdiff1d(np.arange(vertices), cloth.held)
    pairs = cloth.pair_forces
    share = (pairs.weights * (pairs.vertices < vertices)).sum(axis=1)
    force: Floats = cloth.reactions[free].sum(axis=0) + share @ pairs.forces
    return force
