"""Cloth on a sphere: a square of cloth falls on a sphere that then turns and drags it over the floor [thesis, 4.6]."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core._sim_core import self_intersections
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.bodies import Body, plane, sphere
from stickslip_sim_core.cloth.contact import THICKNESS, Surface
from stickslip_sim_core.cloth.fabrics import Fabric, fabric_of
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth

SIDE = 0.2
"""Side of the square of cloth [m]."""

RADIUS = 0.05
"""Of the sphere, which stands on the floor [m]."""

CLEARANCE = 0.005
"""Height of the cloth over the sphere at the start [m]."""

SETTLING = 2.0
"""Time before the sphere begins to turn [s], and the time over which it then gains its speed."""

SPEED = 1.0
"""Of the sphere about its vertical axis, unless another is asked for [rad/s]."""

SPEED_MAX = 20.0
"""[rad/s]"""

BIAS = 1e-3
"""Horizontal over vertical gravity at most until the sphere turns, drawn from the seed, to break the symmetry."""

FRAMES = 150
FRAME_RATE = 15.0
"""[1/s]"""

FRAMES_MAX = 3000


@dataclass(frozen=True, eq=False)
class RotatingSphere:
    """A cloth that fell on a sphere which then turned. World axes: z up, the floor is z = 0, the sphere's axis is z."""

    positions: Floats
    """(frames, V, 3) [m]"""

    rest: Floats
    """(V, 2) [m]"""

    triangles: NDArray[np.int32]
    """(T, 3)"""

    times: Floats
    """(frames,) [s]"""

    angle: Floats
    """(frames,): by which the sphere has turned [rad]."""

    contacts: NDArray[np.int32]
    """(frames, V): 0 on the floor, 1 on the sphere, -1 on neither."""

    contact_force: Floats
    """(frames, 3) [N]: of floor and sphere on the cloth, from the balance of momentum."""

    floor_force: Floats
    """(frames, 3) [N]: of the floor, summed over the vertices that touch it."""

    sphere_force: Floats
    """(frames, 3) [N]: of the sphere, likewise."""

    self_intersections: NDArray[np.int32]
    """(frames,): pairs of triangles that cross."""

    bias: tuple[float, float]
    """Horizontal over vertical gravity (x, y) until the sphere turns."""

    kernel: str
    """Level of the solver's kernels: levels differ in the last digits."""

    steps: int
    unconverged_steps: int
    worst_residual: float
    """Largest residual force of a node in any step, in weights of 25 mm^2 of the cloth."""

    valid: bool
    reason: str
    """Why it is not valid, or empty."""


def turned(time: float, speed: float = SPEED) -> float:
    """Return the angle by which the sphere has turned [rad]: at rest at first, then evenly faster, then at `speed`."""
    t = max(time - SETTLING, 0.0)
    return speed * (0.5 * t * t / SETTLING if t < SETTLING else t - 0.5 * SETTLING)


def ball(mu: float, angle: float) -> Body:
    """Return the sphere, turned by `angle` [rad] about z."""
    c, s = np.cos(angle), np.sin(angle)
    return sphere(mu, RADIUS, origin=(0.0, 0.0, RADIUS), rotation=[[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def triangulated(mu: float, speed: float, subdivisions: int) -> Surface:
    """Return the sphere as triangles that turn: an icosahedron whose triangles are cut into four, again and again.

    Its corners lie half a thickness of the cloth inside: so the middle of the cloth touches at the sphere's radius.
    """
    corners, triangles = meshes.icosphere(subdivisions)
    corners *= RADIUS - 0.5 * THICKNESS

    def at(time: float) -> Floats:
        turn = ball(mu, turned(time, speed))
        placed: Floats = corners @ turn.rotation.T + turn.origin
        return placed

    return Surface(triangles, at, mu, thickness=0.0)


def rotating_sphere(
    fabric: str | Fabric,
    mu: float,
    *,
    mu_floor: float | None = None,
    speed: float = SPEED,
    preset: str | SolverSettings = "certified",
    vertices: int = 41,
    frames: int = FRAMES,
    frame_rate: float = FRAME_RATE,
    seed: int = 0,
    subdivisions: int | None = None,
    kernel: str | None = None,
    on_frame: Callable[[int, int], None] | None = None,
) -> RotatingSphere:
    """Drop a square of cloth on a sphere that stands on the floor, and turn the sphere, which drags it [thesis, 4.6].

    The cloth falls from rest, flat and centred, and drapes over the sphere until its hem lies on the floor.

    Args:
        fabric: One of `fabric_names()`, or a custom one.
        mu: Coefficient of friction between cloth and sphere, 0 ... 10.
        mu_floor: Between cloth and floor; None is `mu`.
        speed: Angular speed of the sphere about its vertical axis [rad/s], -20 ... 20.
        preset: Solver settings, or their name.
        vertices: Vertices a side of the mesh, at least 5.
        frames: Frames to simulate, from time 0 on, 1 ... 3000.
        frame_rate: Frames a second.
        seed: Of the bias.
        subdivisions: Of an icosahedron, 1 ... 7, for a sphere of triangles; None: the sphere is round.
        kernel: Level of the kernels, see `Cloth`.
        on_frame: Called with (frames done, frames) after every frame.

    Raises:
        ValueError: An argument breaks its rule.
    """
    settings = preset_named(preset)
    if not 1 <= frames <= FRAMES_MAX:
        raise ValueError(f"frames: must be 1 ... {FRAMES_MAX}, got {frames}")
    if vertices < 5:
        raise ValueError(f"vertices: must be at least 5, got {vertices}")
    if not (np.isfinite(frame_rate) and frame_rate > 0.0):
        raise ValueError(f"frame_rate: must be finite and > 0, got {frame_rate}")
    if not abs(speed) <= SPEED_MAX:
        raise ValueError(f"speed: must be in [-{SPEED_MAX:g}, {SPEED_MAX:g}] rad/s, got {speed}")
    if subdivisions is not None and not 1 <= subdivisions <= 7:
        raise ValueError(f"subdivisions: must be 1 ... 7, got {subdivisions}")
    floor = plane(mu if mu_floor is None else mu_floor)
    mesh = meshes.grid(SIDE, SIDE, vertices - 1, vertices - 1)
    surfaces = [] if subdivisions is None else [triangulated(mu, speed, subdivisions)]
    cloth = Cloth(mesh, fabric_of(fabric), settings, surfaces=surfaces, kernel=kernel)
    cloth.set_state(np.column_stack([mesh.rest, np.full(len(mesh.rest), 2.0 * RADIUS + CLEARANCE)]))
    bias = np.random.default_rng(seed).uniform(-BIAS, BIAS, 2)

    down = np.tile([0.0, 0.0, -GRAVITY], (len(mesh.rest), 1))
    tilted = down + GRAVITY * np.append(bias, 0.0)

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        bodies = [floor, ball(mu, turned(time, speed))] if subdivisions is None else [floor]
        return (tilted if time < SETTLING else down), np.empty((0, 3)), bodies

    positions, contacts, forces = [cloth.positions], [cloth.contacts], [np.zeros((3, 3))]
    for frame in range(1, frames):
        cloth.advance(frame / frame_rate, motion)
        positions.append(cloth.positions)
        contacts.append(cloth.contacts)
        by_body = [cloth.reactions[contacts[-1] == body].sum(axis=0) for body in (0, 1)]
        forces.append(np.stack([cloth.contact_force(), *by_body]))
        if on_frame is not None:
            on_frame(frame + 1, frames)
        if not np.isfinite(positions[-1]).all():
            break
    path, force = np.stack(positions), np.stack(forces)
    finite = bool(np.isfinite(path).all())
    times = np.arange(len(path)) / frame_rate
    reason = cloth.why_invalid(path)
    return RotatingSphere(
        positions=path,
        rest=mesh.rest,
        triangles=mesh.triangles,
        times=times,
        angle=np.array([turned(float(t), speed) for t in times]),
        contacts=np.stack(contacts),
        contact_force=force[:, 0],
        floor_force=force[:, 1],
        sphere_force=force[:, 2],
        self_intersections=np.array([self_intersections(p, mesh.triangles) if finite else 0 for p in path], np.int32),
        bias=(float(bias[0]), float(bias[1])),
        kernel=cloth.kernel,
        steps=cloth.steps,
        unconverged_steps=cloth.unconverged_steps,
        worst_residual=cloth.worst_residual,
        valid=not reason,
        reason=reason,
    )
