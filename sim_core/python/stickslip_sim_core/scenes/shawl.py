"""A shawl: a cloth is laid over the shoulders of a figure, which then moves [thesis, 4.6]."""

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.bodies import Body, plane
from stickslip_sim_core.cloth.contact import SELF_FRICTION, SelfContact, Surface
from stickslip_sim_core.cloth.fabrics import Fabric, fabric_of
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.scenes.character import bones, figure
from stickslip_sim_core.scenes.scene import Scene, check_range, cloth_kind

NECKLINE, HEM, ANGLE = 0.095, 0.5, 5.3
"""The shawl is cut as a part of a ring: its radii inside and outside [m], and its angle [rad]."""

APEX, SLOPE = 0.70, 0.4
"""It starts as part of a cone about the neck, open in front: how high the apex is [m], and how steep its sides are
[rad]."""

SWING_MAX = 2.0
"""Largest size of the figure's motion; 1 is usual."""

VERTICES_MIN = 9
"""Along a side of the mesh: a coarser shawl cannot follow the shoulders."""

BIAS = 1e-3
"""Horizontal over vertical gravity at most, drawn from the seed, until the figure moves: it breaks the symmetry."""

UPRIGHT = 3.0
"""Time at which the bias ends [s]."""

LAYING, CALM = 2.0, 10.0
"""Time for which the shawl is damped as it is laid down [s], and that damping, in proportion to its mass [1/s]."""

FRAMES, FRAME_RATE = 150, 15.0
"""10 s, 15 a second."""


def cut(cells: int) -> meshes.Mesh:
    """Return the flat shawl of so many cells a side: along the ring, the warp, and outward.

    Rings are so far apart that all cells are alike. The middle of the back is at x = 0, y < 0.
    """
    square = meshes.grid(1.0, 1.0, cells, cells)
    angle, share = ANGLE * square.rest[:, 0], 0.5 - square.rest[:, 1]
    radius = NECKLINE * (HEM / NECKLINE) ** share
    return meshes.Mesh(np.stack([radius * np.sin(angle), -radius * np.cos(angle)], axis=1), square.triangles)


def laid(rest: Floats) -> Floats:
    """Return the start (V, 3) [m] of a shawl whose flat shape is (V, 2) [m]: bent to a cone, not stretched.

    A point at a distance r from the apex, at an angle phi from the middle of the back, goes to azimuth phi / cos(s),
    r cos(s) from the axis and r sin(s) below the apex; s is the slope.
    """
    radius, azimuth = np.hypot(rest[:, 0], rest[:, 1]), np.arctan2(rest[:, 0], -rest[:, 1]) / np.cos(SLOPE)
    out = radius * np.cos(SLOPE)
    return np.stack([-out * np.cos(azimuth), out * np.sin(azimuth), APEX - radius * np.sin(SLOPE)], axis=1)


def scene(
    material: str | Fabric,
    mu: float,
    *,
    self_friction: float = SELF_FRICTION,
    swing: float = 1.0,
    preset: str | SolverSettings = "certified",
    mesh: int = 61,
    frames: int = FRAMES,
    seed: int = 0,
    kernel: str | None = None,
) -> Scene:
    """Return the scene of a shawl that is laid over the shoulders of a figure, which then moves.

    The figure looks along x at first; the floor is z = 0.

    Args:
        material: One of `fabric_names()`, or a fabric.
        mu: Coefficient of friction of the cloth with figure and floor, 0 ... 10.
        self_friction: Of the cloth with itself, 0 ... 10.
        swing: Size of the figure's motion, 0 ... 2; see `character.bones`.
        preset: Solver settings, or their name.
        mesh: Vertices a side of the grid, at least 9; 31 or more show folds.
        frames: Frames, 15 a second from 0 on; 150 are the whole motion.
        seed: Of the bias.
        kernel: Level of the kernels, see `Cloth`.

    Raises:
        ValueError: An argument breaks its rule.
    """
    check_range("frames", frames, 1, FRAMES)
    check_range("mesh", mesh, VERTICES_MIN, np.inf)
    check_range("swing", swing, 0.0, SWING_MAX)
    body, flat = figure(), cut(mesh - 1)
    bias = np.random.default_rng(seed).uniform(-BIAS, BIAS, 2)
    down = np.tile([0.0, 0.0, -GRAVITY], (len(flat.rest), 1))
    tilted = down + GRAVITY * np.append(bias, 0.0)
    floor = [plane(mu)]

    def motion(time: float) -> tuple[Floats, list[Body]]:
        return (tilted if time < UPRIGHT else down), floor

    return Scene(
        mesh=flat,
        fabrics=[fabric_of(material)],
        preset=preset_named(preset),
        start=laid(flat.rest),
        motion=motion,
        self_contact=SelfContact(self_friction),
        surfaces=[Surface(body.triangles, lambda time: body.moved(bones(time, swing)), mu)],
        damping=lambda time: CALM if time <= LAYING else 0.0,
        frames=frames,
        frame_rate=FRAME_RATE,
        tracks={"bones": lambda time: bones(time, swing)},
        record={"skin_rest": body.rest, "skin_triangles": body.triangles, "skin_weights": body.weights},
        labels=lambda run: {"bias": bias.tolist(), "least_distance": float(run.least_distance)},
        kernel=kernel,
    )


KIND = cloth_kind(scene)
