"""A shawl: a cloth is laid over the shoulders of a figure, which then moves [thesis, 4.6]."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core._sim_core import self_intersections
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.character import bones, figure
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.bodies import Body, plane
from stickslip_sim_core.cloth.contact import SELF_FRICTION, SelfContact, Surface
from stickslip_sim_core.cloth.fabrics import Fabric, fabric_of
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth

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
"""When it ends [s]."""

LAYING, CALM = 2.0, 10.0
"""The shawl is laid down gently: for so long [s] it is damped in proportion to its mass [1/s]."""

FRAMES, FRAME_RATE = 150, 15.0
"""10 s, 15 a second."""


@dataclass(frozen=True, eq=False)
class Shawl:
    """A cloth on a figure's shoulders. World axes: the figure looks along x at first, z is up, the floor is z = 0."""

    positions: Floats
    """(frames, V, 3) [m]"""

    rest: Floats
    """(V, 2) [m]"""

    triangles: NDArray[np.int32]
    """(T, 3)"""

    times: Floats
    """(frames,) [s]"""

    skin_rest: Floats
    """(N, 3) [m]: the figure's skin at rest."""

    skin_triangles: NDArray[np.int32]
    """(U, 3)"""

    skin_weights: Floats
    """(N, bones): how much each vertex follows each bone, see `character.Figure`."""

    bones: Floats
    """(frames, bones, 3, 4): where the bones are."""

    contact_force: Floats
    """(frames, 3) [N]: of figure and floor on the cloth, from the balance of momentum."""

    self_intersections: NDArray[np.int32]
    """(frames,): pairs of triangles that cross."""

    least_distance: float
    """Of pieces of cloth that do not hang together, and of cloth and figure, at the ends of all steps [m]."""

    bias: tuple[float, float]
    """Horizontal over vertical gravity (x, y) until the figure moves."""

    kernel: str
    """Level of the solver's kernels: levels differ in the last digits."""

    steps: int
    unconverged_steps: int
    worst_residual: float
    """Largest residual force of a node in any step, in weights of 25 mm^2 of the cloth."""

    valid: bool
    reason: str
    """Why it is not valid, or empty."""


def cut(cells: int) -> meshes.Mesh:
    """Return the flat shawl of so many cells a side: along the ring, the warp, and outward.

    Rings are so far apart that all cells are alike. The middle of the back is at x = 0, y < 0.
    """
    square = meshes.grid(1.0, 1.0, cells, cells)
    angle, share = ANGLE * square.rest[:, 0], 0.5 - square.rest[:, 1]
    radius = NECKLINE * (HEM / NECKLINE) ** share
    return meshes.Mesh(np.stack([radius * np.sin(angle), -radius * np.cos(angle)], axis=1), square.triangles)


def laid(rest: Floats) -> Floats:
    """Return where the shawl starts (V, 3) [m] whose flat shape is (V, 2) [m]: bent to a cone, not stretched.

    A point at a distance r from the apex, at an angle phi from the middle of the back, goes to azimuth phi / cos(s),
    r cos(s) from the axis and r sin(s) below the apex; s is the slope.
    """
    radius, azimuth = np.hypot(rest[:, 0], rest[:, 1]), np.arctan2(rest[:, 0], -rest[:, 1]) / np.cos(SLOPE)
    out = radius * np.cos(SLOPE)
    return np.stack([-out * np.cos(azimuth), out * np.sin(azimuth), APEX - radius * np.sin(SLOPE)], axis=1)


def shawl_on_figure(
    fabric: str | Fabric,
    mu: float,
    *,
    self_friction: float = SELF_FRICTION,
    swing: float = 1.0,
    preset: str | SolverSettings = "certified",
    vertices: int = 61,
    frames: int = FRAMES,
    seed: int = 0,
    kernel: str | None = None,
    on_frame: Callable[[int, int], None] | None = None,
) -> Shawl:
    """Lay a shawl over a figure's shoulders and let the figure move.

    Args:
        fabric: One of `fabric_names()`, or a custom one.
        mu: Coefficient of friction of the cloth with figure and floor, 0 ... 10.
        self_friction: Of the cloth with itself, 0 ... 10.
        swing: Size of the figure's motion, 0 ... 2; see `character.bones`.
        preset: Solver settings, or their name.
        vertices: Vertices a side of the mesh, at least 9; 31 or more show folds.
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
    if vertices < VERTICES_MIN:
        raise ValueError(f"vertices: must be at least {VERTICES_MIN}, got {vertices}")
    if not 0.0 <= swing <= SWING_MAX:
        raise ValueError(f"swing: must be in [0, {SWING_MAX:g}], got {swing}")
    body = figure()
    mesh = cut(vertices - 1)
    cloth = Cloth(
        mesh,
        fabric_of(fabric),
        settings,
        self_contact=SelfContact(self_friction),
        surfaces=[Surface(body.triangles, lambda time: body.moved(bones(time, swing)), mu)],
        kernel=kernel,
    )
    cloth.set_state(laid(mesh.rest))
    bias = np.random.default_rng(seed).uniform(-BIAS, BIAS, 2)
    down = np.tile([0.0, 0.0, -GRAVITY], (len(mesh.rest), 1))
    tilted = down + GRAVITY * np.append(bias, 0.0)
    floor = [plane(mu)]

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        return (tilted if time < UPRIGHT else down), np.empty((0, 3)), floor

    positions, forces = [cloth.positions], [np.zeros(3)]
    for frame in range(1, frames):
        cloth.advance(frame / FRAME_RATE, motion, damping=CALM if frame <= LAYING * FRAME_RATE else 0.0)
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
        skin_rest=body.rest,
        skin_triangles=body.triangles,
        skin_weights=body.weights,
        bones=np.stack([bones(float(t), swing) for t in times]),
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
