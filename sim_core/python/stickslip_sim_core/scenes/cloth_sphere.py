"""Cloth on a sphere: a square of cloth falls on a sphere that then turns and drags it over the floor [thesis, 4.6]."""

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.bodies import Body, plane, sphere
from stickslip_sim_core.cloth.fabrics import Fabric, fabric_of
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.scenes.kind import Record
from stickslip_sim_core.scenes.scene import Scene, check_range, cloth_kind

SIDE = 0.2
"""Side of the square of cloth [m]."""

RADIUS = 0.05
"""Of the sphere, which stands on the floor [m]."""

CLEARANCE = 0.005
"""Height of the cloth over the sphere at the start [m]."""

SETTLING = 2.0
"""Time before the sphere begins to turn [s], and the time over which it then gains its speed."""

SPEED = 1.0
"""Default angular speed of the sphere about its vertical axis [rad/s]."""

SPEED_MAX = 20.0
"""[rad/s]"""

BIAS = 1e-3
"""Horizontal over vertical gravity at most until the sphere turns, drawn from the seed, to break the symmetry."""

FRAMES = 150
FRAME_RATE = 15.0
"""[1/s]"""

FRAMES_MAX = 3000


def turned(time: float, speed: float = SPEED) -> float:
    """Return the angle by which the sphere has turned [rad]: at rest at first, then evenly faster, then at `speed`."""
    t = max(time - SETTLING, 0.0)
    return speed * (0.5 * t * t / SETTLING if t < SETTLING else t - 0.5 * SETTLING)


def ball(mu: float, angle: float) -> Body:
    """Return the sphere, turned by `angle` [rad] about z."""
    c, s = np.cos(angle), np.sin(angle)
    return sphere(mu, RADIUS, origin=(0.0, 0.0, RADIUS), rotation=[[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def scene(
    material: str | Fabric,
    mu: float,
    *,
    mu_floor: float | None = None,
    angular_speed: float = SPEED,
    preset: str | SolverSettings = "certified",
    mesh: int = 41,
    frames: int = FRAMES,
    frame_rate: float = FRAME_RATE,
    seed: int = 0,
    kernel: str | None = None,
) -> Scene:
    """Return the scene of a square of cloth that falls on a sphere, which then turns and drags it.

    The cloth falls from rest, flat and centred, and drapes over the sphere until its hem lies on the floor.

    Args:
        material: One of `fabric_names()`, or a fabric.
        mu: Coefficient of friction between cloth and sphere, 0 ... 10.
        mu_floor: Between cloth and floor; None is `mu`.
        angular_speed: Of the sphere about its vertical axis [rad/s], -20 ... 20.
        preset: Solver settings, or their name.
        mesh: Vertices a side of the grid, at least 5.
        frames: Frames, from time 0 on, 1 ... 3000.
        frame_rate: Frames a second.
        seed: Of the bias.
        kernel: Level of the kernels, see `Cloth`.

    Raises:
        ValueError: An argument breaks its rule.
    """
    check_range("frames", frames, 1, FRAMES_MAX)
    check_range("mesh", mesh, 5, np.inf)
    check_range("angular_speed", angular_speed, -SPEED_MAX, SPEED_MAX)
    if not (np.isfinite(frame_rate) and frame_rate > 0.0):
        raise ValueError(f"frame_rate: must be finite and > 0, got {frame_rate}")
    floor = plane(mu if mu_floor is None else mu_floor)
    square = meshes.grid(SIDE, SIDE, mesh - 1, mesh - 1)
    bias = np.random.default_rng(seed).uniform(-BIAS, BIAS, 2)
    down = np.tile([0.0, 0.0, -GRAVITY], (len(square.rest), 1))
    tilted = down + GRAVITY * np.append(bias, 0.0)

    def motion(time: float) -> tuple[Floats, list[Body]]:
        bodies = [floor, ball(mu, turned(time, angular_speed))]
        return (tilted if time < SETTLING else down), bodies

    return Scene(
        mesh=square,
        fabrics=[fabric_of(material)],
        preset=preset_named(preset),
        start=np.column_stack([square.rest, np.full(len(square.rest), 2.0 * RADIUS + CLEARANCE)]),
        motion=motion,
        frames=frames,
        frame_rate=frame_rate,
        forces=forces,
        tracks={
            "angle": lambda time: turned(time, angular_speed),
            "sphere_pose": lambda time: ball(mu, turned(time, angular_speed)).pose,
        },
        labels=lambda _run: {"bias": bias.tolist()},
        kernel=kernel,
    )


KIND = cloth_kind(scene)


def forces(cloth: Cloth) -> Record:
    """Return the forces on the cloth (3,) [N]: of all bodies, of the floor and of the sphere."""
    of_floor, of_sphere = cloth.body_forces(2)
    return {"contact_force": cloth.contact_force(), "floor_force": of_floor, "sphere_force": of_sphere}
