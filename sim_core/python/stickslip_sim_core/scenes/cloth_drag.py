"""Drop and drag: a square of cloth, held at two corners, is lowered onto a floor and dragged [thesis, 4.2.3]."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core._sim_core import self_intersections
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.fabrics import Fabric, fabric_of
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Body, Cloth, Motion, plane

SIDE = 0.2
"""Side of the square of cloth [m]."""

HOLDER = 0.01
"""Side of the square holders at two corners [m]."""

CLEARANCE = 0.01
"""Height of the lower edge over the floor at the start [m]."""

DROP, DRAG, LEGS = 0.06, 0.3, 4
"""Travel down, travel of each leg [m], and number of legs: there, back, there, back."""

SPEED, ACCELERATION = 0.01, 0.01
"""Of the motorised stages [m/s, m/s^2]."""

FRAME_RATE = 2.4
"""[1/s]"""


def travel(time: float, distance: float) -> float:
    """Return how far holders have come that start and end at rest with `ACCELERATION` and cruise at `SPEED` [m]."""
    ramp = SPEED / ACCELERATION
    duration = duration_of(distance)
    t = min(max(time, 0.0), duration)
    if t < ramp:
        return 0.5 * ACCELERATION * t * t
    if t > duration - ramp:
        return distance - 0.5 * ACCELERATION * (duration - t) ** 2
    return SPEED * (t - 0.5 * ramp)


def duration_of(distance: float) -> float:
    """Return the time of a travel of at least SPEED^2 / ACCELERATION [s]."""
    return distance / SPEED + SPEED / ACCELERATION


def holder_path(time: float) -> Floats:
    """Return the displacement (x, z) of the holders [m]: down, then to and fro [thesis, 4.2.3]."""
    start, leg = duration_of(DROP), duration_of(DRAG)
    x, direction = 0.0, 1.0
    for i in range(LEGS):
        x += direction * travel(time - start - i * leg, DRAG)
        direction = -direction
    return np.array([x, -travel(time, DROP)])


DURATION = duration_of(DROP) + LEGS * duration_of(DRAG)
"""Of drop-and-drag [s]."""

SETTLING_STEPS = 40
"""Damped steps of 50 ms after which the cloth hangs at rest."""

FRAMES = 300
"""Frames of a whole drop-and-drag."""


@dataclass(frozen=True, eq=False)
class DropAndDrag:
    """A cloth that was dropped and dragged. World axes: z up, the floor is z = 0, the holders travel along x."""

    positions: Floats
    """(frames, V, 3) [m]"""

    rest: Floats
    """(V, 2) [m]: the first axis, the warp, runs along the held edge (world y), the second up the cloth."""

    triangles: NDArray[np.int32]
    """(T, 3)"""

    times: Floats
    """(frames,) [s]"""

    contact_force: Floats
    """(frames, 3) [N]: of the floor on the cloth, from the balance of momentum."""

    holder_force: Floats
    """(frames, 3) [N]: of the holders on the cloth."""

    self_intersections: NDArray[np.int32]
    """(frames,): pairs of triangles that cross."""

    side: int
    """+1 or -1: to which side along x the bias broke the symmetry of the drop."""

    bias: float
    """Its size: horizontal over vertical gravity during the drop."""

    steps: int
    unconverged_steps: int
    worst_residual: float
    """Largest residual force of a node in any step, in weights of a node."""

    valid: bool
    reason: str
    """Why it is not valid, or empty."""


@dataclass(frozen=True, eq=False)
class Tilt:
    """Gravity along x, over that along -z, which breaks the symmetry of the drop."""

    side: int
    bias: float
    of_vertices: Floats
    """(V,)"""


def held_by_holders(mesh: meshes.Mesh) -> NDArray[np.intp]:
    """Return the vertices of the square of cloth under the holders, at the two corners of its upper edge."""
    inner = SIDE / 2 - HOLDER - 1e-9
    return np.flatnonzero((np.abs(mesh.rest[:, 0]) > inner) & (mesh.rest[:, 1] > inner))


def hang(cloth: Cloth, floor: list[Body], *, seed: int) -> tuple[Floats, Tilt]:
    """Let the cloth come to rest under its holders; return their vertices' positions (K, 3) and the tilt of gravity."""
    rest = cloth.mesh.rest
    hung = np.zeros((len(rest), 3))
    hung[:, 1] = rest[:, 0]
    hung[:, 2] = rest[:, 1] + SIDE / 2 + CLEARANCE
    rng = np.random.default_rng(seed)
    side = 1 if rng.random() < 0.5 else -1
    bias = float(rng.uniform(1e-3, 3e-3))
    twist = float(rng.uniform(-0.3, 0.3))
    tilt = Tilt(side, bias, side * bias * (1.0 + twist * rest[:, 0] / (SIDE / 2)))
    cloth.set_state(hung)
    cloth.gravity[:, 0] = tilt.of_vertices * GRAVITY
    for _ in range(SETTLING_STEPS):
        cloth.step(0.05, held=hung[cloth.held], bodies=floor, damping=5.0)
    cloth.set_state(cloth.positions)
    cloth.time = 0.0
    return hung[cloth.held], tilt


def motion_of(cloth: Cloth, floor: list[Body], hung: Floats, tilt: Tilt) -> Motion:
    """Return what drives the cloth after the holders have started; gravity is upright one second after the drop."""

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        upright = min(max(time - duration_of(DROP), 0.0), 1.0)
        gravity = np.tile([0.0, 0.0, -GRAVITY], (len(cloth.mesh.rest), 1))
        gravity[:, 0] = tilt.of_vertices * GRAVITY * (1.0 - upright)
        x, z = holder_path(time)
        return gravity, hung + np.array([x, 0.0, z]), floor

    return motion


def drop_and_drag(
    fabric: str | Fabric,
    mu: float,
    *,
    preset: str | SolverSettings = "certified",
    vertices: int = 41,
    frames: int = FRAMES,
    seed: int = 0,
    mesh: meshes.Mesh | None = None,
) -> DropAndDrag:
    """Hold a square of cloth by two corners, lower it onto a plane and drag it to and fro [thesis, 4.2.3].

    The cloth hangs at rest, 1 cm over the floor, when the holders start to move. A drop without imperfection would
    buckle to neither side: gravity is tilted along x by `bias`, a little more on one side of the cloth than on the
    other, both drawn from `seed`, until the drop ends, and set upright within the second after.

    Args:
        fabric: One of `fabric_names()`, or one of your own.
        mu: Coefficient of friction between cloth and floor, >= 0.
        preset: Solver settings, or their name.
        vertices: Vertices a side of the mesh, at least 5.
        frames: Frames to simulate, 2.4 a second from 0 on; 300 are the whole motion.
        seed: Of the bias.
        mesh: Instead of the structured mesh of `vertices`: one of the square of side `SIDE`.

    Raises:
        ValueError: An argument breaks its rule.
    """
    settings = preset_named(preset)
    if not 1 <= frames <= FRAMES:
        raise ValueError(f"frames: must be 1 ... {FRAMES}, got {frames}")
    if vertices < 5:
        raise ValueError(f"vertices: must be at least 5, got {vertices}")
    mesh = meshes.grid(SIDE, SIDE, vertices - 1, vertices - 1) if mesh is None else mesh
    held = held_by_holders(mesh)
    floor = [plane(mu)]
    cloth = Cloth(mesh, fabric_of(fabric), settings, held=held)
    hung, tilt = hang(cloth, floor, seed=seed)
    motion = motion_of(cloth, floor, hung, tilt)
    weight = cloth.masses.sum() * np.array([0.0, 0.0, -GRAVITY])
    positions, contact, holders = [cloth.positions], [np.zeros(3)], [-weight]
    for frame in range(1, frames):
        cloth.advance(frame / FRAME_RATE, motion)
        contact.append(cloth.contact_force())
        holders.append(cloth.reactions[held].sum(axis=0))
        positions.append(cloth.positions)
        if not np.isfinite(positions[-1]).all():
            break
    path = np.stack(positions)
    finite = bool(np.isfinite(path).all())
    reason = cloth.why_invalid(path)
    return DropAndDrag(
        positions=path,
        rest=mesh.rest,
        triangles=mesh.triangles,
        times=np.arange(len(path)) / FRAME_RATE,
        contact_force=np.stack(contact),
        holder_force=np.stack(holders),
        self_intersections=np.array([self_intersections(p, mesh.triangles) if finite else 0 for p in path], np.int32),
        side=tilt.side,
        bias=tilt.bias,
        steps=cloth.steps,
        unconverged_steps=cloth.unconverged_steps,
        worst_residual=cloth.worst_residual,
        valid=not reason,
        reason=reason,
    )
