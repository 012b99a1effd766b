"""A shawl: a square of cloth falls on the shoulders of a figure, which then twists to and fro [thesis, 4.6]."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core._sim_core import self_intersections
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.fabrics import Fabric, fabric_of
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Body, Cloth, SelfContact, Surface

SIDE = 0.6
"""Side of the square of cloth [m]."""

PROFILE = (
    (0.0, 0.15, 0.10),
    (0.2, 0.16, 0.11),
    (0.4, 0.19, 0.12),
    (0.5, 0.20, 0.10),
    (0.55, 0.16, 0.08),
    (0.58, 0.08, 0.065),
    (0.61, 0.06, 0.055),
    (0.67, 0.05, 0.05),
    (0.69, 0.0, 0.0),
)
"""Of the figure, from the waist to the neck: height, half its width along y and half its depth along x [m]."""

RINGS, AROUND = 40, 48
"""Of the figure's mesh."""

ROUNDED = 0.03
"""Lengths along the profile over which its corners are rounded [m]."""

CLEARANCE = 0.01
"""Height of the cloth over the neck at the start [m]."""

SETTLING = 3.0
"""Time before the figure begins to twist [s]."""

PERIOD = 3.0
"""Of its twisting [s]."""

SWING, SWING_MAX = 0.5, 1.5
"""How far it twists to each side, unless another is asked for, and at most [rad]."""

BIAS = 1e-3
"""Horizontal over vertical gravity at most, drawn from the seed, until the figure twists, to break the symmetry."""

FRAMES, FRAME_RATE = 150, 15.0
"""10 s, 15 a second."""


@dataclass(frozen=True, eq=False)
class Shawl:
    """A cloth that fell on a figure which then twisted. World axes: z up, y along the shoulders; the waist is z = 0."""

    positions: Floats
    """(frames, V, 3) [m]"""

    rest: Floats
    """(V, 2) [m]"""

    triangles: NDArray[np.int32]
    """(T, 3)"""

    times: Floats
    """(frames,) [s]"""

    angle: Floats
    """(frames,): by which the figure has twisted [rad]."""

    contact_force: Floats
    """(frames, 3) [N]: of the figure on the cloth, from the balance of momentum."""

    self_intersections: NDArray[np.int32]
    """(frames,): pairs of triangles that cross."""

    least_distance: float
    """Of pieces of cloth that do not hang together, and of cloth and figure, at the ends of all steps [m]."""

    bias: tuple[float, float]
    """Horizontal over vertical gravity (x, y) until the figure twists."""

    kernel: str
    """Level of the solver's kernels: levels differ in the last digits."""

    steps: int
    unconverged_steps: int
    worst_residual: float
    """Largest residual force of a node in any step, in weights of 25 mm^2 of the cloth."""

    valid: bool
    reason: str
    """Why it is not valid, or empty."""


def twisted(time: float, swing: float = SWING) -> float:
    """Return the angle by which the figure has twisted [rad]: from rest, to one side and the other."""
    t = max(time - SETTLING, 0.0)
    ease = min(t / PERIOD, 1.0)
    return swing * ease * ease * (3.0 - 2.0 * ease) * float(np.sin(2.0 * np.pi * t / PERIOD))


def figure() -> tuple[Floats, NDArray[np.int32]]:
    """Return the figure: vertices (RINGS * AROUND + 1, 3) [m] and triangles. It is open at the waist."""
    z, half_width, half_depth = np.array(PROFILE).T
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(z), np.diff(half_width)))])
    fine = np.linspace(0.0, along[-1], 2001)
    near = np.exp(-0.5 * ((np.linspace(0.0, along[-1], RINGS)[:, None] - fine) / (0.4 * ROUNDED)) ** 2)
    near /= near.sum(axis=1, keepdims=True)
    height, width, depth = (near @ np.interp(fine, along, column) for column in (z, half_width, half_depth))
    angle = 2.0 * np.pi * np.arange(AROUND) / AROUND
    rings = np.stack(
        [np.outer(depth, np.cos(angle)), np.outer(width, np.sin(angle)), np.repeat(height[:, None], AROUND, axis=1)],
        axis=-1,
    )
    triangles = []
    for ring in range(RINGS - 1):
        for k in range(AROUND):
            a, b = ring * AROUND + k, ring * AROUND + (k + 1) % AROUND
            triangles += [(a, b, b + AROUND), (a, b + AROUND, a + AROUND)]
    top, last = RINGS * AROUND, (RINGS - 1) * AROUND
    triangles += [(last + k, last + (k + 1) % AROUND, top) for k in range(AROUND)]
    vertices = np.concatenate([rings.reshape(-1, 3), [[0.0, 0.0, height[-1] + 0.1 * width[-1]]]])
    return vertices, np.array(triangles, dtype=np.int32)


def shawl(
    fabric: str | Fabric,
    mu: float,
    *,
    self_friction: float = 0.5,
    swing: float = SWING,
    preset: str | SolverSettings = "certified",
    vertices: int = 61,
    frames: int = FRAMES,
    seed: int = 0,
    kernel: str | None = None,
    on_frame: Callable[[int, int], None] | None = None,
) -> Shawl:
    """Drop a square of cloth on a figure's shoulders and twist the figure to and fro.

    Args:
        fabric: One of `fabric_names()`, or one of your own.
        mu: Coefficient of friction between cloth and figure, 0 ... 10.
        self_friction: Of the cloth with itself, 0 ... 10.
        swing: How far the figure twists to each side [rad], -1.5 ... 1.5.
        preset: Solver settings, or their name.
        vertices: Vertices a side of the mesh, at least 5.
        frames: Frames to simulate, 15 a second from 0 on; 150 are the whole motion.
        seed: Of the bias.
        kernel: Level of the kernels, see `Cloth`.
        on_frame: Called with (frames done, frames) after every frame.

    Raises:
        ValueError: An argument breaks its rule.
    """
    settings = preset_named(preset)
    if not 1 <= frames <= FRAMES:
        raise ValueError(f"frames: must be 1 ... {FRAMES}, got {frames}")
    if vertices < 5:
        raise ValueError(f"vertices: must be at least 5, got {vertices}")
    if not abs(swing) <= SWING_MAX:
        raise ValueError(f"swing: must be in [-{SWING_MAX:g}, {SWING_MAX:g}] rad, got {swing}")
    body, triangles = figure()

    def at(time: float) -> Floats:
        c, s = np.cos(twisted(time, swing)), np.sin(twisted(time, swing))
        turned: Floats = body @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return turned

    mesh = meshes.grid(SIDE, SIDE, vertices - 1, vertices - 1)
    cloth = Cloth(
        mesh,
        fabric_of(fabric),
        settings,
        self_contact=SelfContact(self_friction),
        surfaces=[Surface(triangles, at, mu)],
        kernel=kernel,
    )
    cloth.set_state(np.column_stack([mesh.rest, np.full(len(mesh.rest), body[:, 2].max() + CLEARANCE)]))
    bias = np.random.default_rng(seed).uniform(-BIAS, BIAS, 2)
    down = np.tile([0.0, 0.0, -GRAVITY], (len(mesh.rest), 1))
    tilted = down + GRAVITY * np.append(bias, 0.0)

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        return (tilted if time < SETTLING else down), np.empty((0, 3)), []

    positions, forces = [cloth.positions], [np.zeros(3)]
    for frame in range(1, frames):
        cloth.advance(frame / FRAME_RATE, motion)
        positions.append(cloth.positions)
        forces.append(cloth.contact_force())
        if on_frame is not None:
            on_frame(frame + 1, frames)
        if not np.isfinite(positions[-1]).all():
            break
    path = np.stack(positions)
    finite = bool(np.isfinite(path).all())
    times = np.arange(len(path)) / FRAME_RATE
    reason = cloth.why_invalid(path)
    return Shawl(
        positions=path,
        rest=mesh.rest,
        triangles=mesh.triangles,
        times=times,
        angle=np.array([twisted(float(t), swing) for t in times]),
        contact_force=np.stack(forces),
        self_intersections=np.array([self_intersections(p, mesh.triangles) if finite else 0 for p in path], np.int32),
        least_distance=cloth.least_distance,
        bias=(float(bias[0]), float(bias[1])),
        kernel=cloth.kernel,
        steps=cloth.steps,
        unconverged_steps=cloth.unconverged_steps,
        worst_residual=cloth.worst_residual,
        valid=not reason,
        reason=reason,
    )
