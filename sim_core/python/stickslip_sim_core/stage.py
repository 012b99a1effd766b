"""The stage of drop-and-drag [thesis, 4.2.3]: the way of the holders, the cloth that hangs from them, and its run.

What the cloth is dragged over is a scene's: `scenes.cloth_drag`, `scenes.cloth_on_cloth`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core._sim_core import self_intersections
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.bodies import Body
from stickslip_sim_core.cloth.fabrics import Fabric
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth, Motion

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

HANGING = SolverSettings("hanging", 0.05, tolerance=1e-5, step_error=None)
"""How the hung shape is found, whatever the preset, so that all presets start from the same."""

HANGING_TILTS = (30.0, 10.0, 3.0, 1.0)
"""The bias is this many times as large at first: the cloth then has one shape, which is followed as the bias falls."""

SETTLING_STEPS, SETTLING_DAMPING = 25, 5.0
"""Steps for each of these, and their damping [1/s]."""

FIRST_STEP, GROWTH = 0.002, 1.3
"""The flat cloth buckles when it is let go: the first step [s], and by how much the next ones grow, up to 50 ms."""

LONGEST, AT_REST, HANGING_STEPS_MAX = 1.0, 1e-8, 400
"""Steps then grow to this length [s], until no vertex moves further than this in one [m]; and how many there may be."""

SHORTENED = 0.1
"""Part of each step that is taken once a step is longer than half of the one before. A step has the stiffness that the
cloth had at the step's start, so a fabric that stiffens fast would swing about its shape at rest for ever."""

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
    """(frames, 3) [N]: of the floor, or of the stretched cloth, on the cloth: from the balance of momentum if it is a
    floor."""

    holder_force: Floats
    """(frames, 3) [N]: of the holders on the cloth."""

    self_intersections: NDArray[np.int32]
    """(frames,): pairs of triangles that cross."""

    bias_side: int
    """+1 or -1: to which side along x the bias breaks the symmetry of the drop."""

    bias: float
    """Its size: horizontal over vertical gravity during the drop."""

    hung_side: int
    """+1 or -1: to which side along x the cloth bellied as it hung; the bias chooses it."""

    hung_softest: float
    """Smallest eigenvalue of stiffness over mass as it hung [1/s^2]: positive, since it is stable."""

    landed_side: int
    """+1 or -1: on which side of the holders, along x, the cloth lay when the drop ended; 0 if it was not simulated."""

    landed_offset: float
    """Mean x of the cloth less that of the holders then [m], or NaN."""

    others: Floats
    """(frames, W, 3) [m]: of the sheets that are not dragged, if there are any."""

    least_distance: float
    """Of pieces of cloth that do not hang together, at the ends of all steps [m]; inf where none came near, or where
    the cloth does not feel itself."""

    kernel: str
    """Level of the solver's kernels: levels differ in the last digits."""

    steps: int
    unconverged_steps: int
    worst_residual: float
    """Largest residual force of a node in any step, in weights of 25 mm^2 of the cloth."""

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


@dataclass(frozen=True, eq=False)
class Hung:
    """The shape of a cloth at rest under its holders."""

    positions: Floats
    """(V, 3) [m]"""

    tilt: Tilt
    side: int
    softest: float
    reason: str
    """Why it is no stable equilibrium, or empty."""


def hang(mesh: meshes.Mesh, fabric: Fabric, *, seed: int, kernel: str | None = None) -> Hung:
    """Return the shape in which the cloth hangs at rest under its holders, over the floor.

    A cloth held at two corners has many shapes at rest. This is the one that is reached as the tilt of gravity falls
    from 30 times the bias to the bias; it is settled until nothing moves, and its stability is checked.
    """
    held = held_by_holders(mesh)
    cloth = Cloth(mesh, fabric, HANGING, held=held, kernel=kernel)
    flat = np.zeros((len(mesh.rest), 3))
    flat[:, 1] = mesh.rest[:, 0]
    flat[:, 2] = mesh.rest[:, 1] + SIDE / 2 + CLEARANCE
    rng = np.random.default_rng(seed)
    side = 1 if rng.random() < 0.5 else -1
    bias = float(rng.uniform(1e-3, 3e-3))
    twist = float(rng.uniform(-0.3, 0.3))
    tilt = Tilt(side, bias, side * bias * (1.0 + twist * mesh.rest[:, 0] / (SIDE / 2)))
    cloth.set_state(flat)
    dt = FIRST_STEP
    for times in HANGING_TILTS:
        cloth.gravity[:, 0] = times * tilt.of_vertices * GRAVITY
        for _ in range(SETTLING_STEPS):
            cloth.step(dt, held=flat[held], damping=SETTLING_DAMPING)
            dt = min(GROWTH * dt, HANGING.time_step)
    moved, steps, share = np.inf, 0, 1.0
    while (dt < LONGEST or moved > AT_REST) and steps < HANGING_STEPS_MAX:
        before, moved_before = cloth.positions, moved
        dt = min(1.5 * dt, LONGEST)
        cloth.step(dt, held=flat[held], damping=SETTLING_DAMPING)
        moved, steps = float(np.abs(cloth.positions - before).max()), steps + 1
        if dt == LONGEST and moved > 0.5 * moved_before:
            share = SHORTENED
        if share < 1.0 and moved > AT_REST:
            cloth.set_state(before + share * (cloth.positions - before))
    softest = cloth.softest()
    reason = ""
    if not moved <= AT_REST:
        reason = f"the hung cloth did not come to rest: it moved by {moved:.1e} m in {dt:g} s"
    elif not softest > 0.0:
        reason = f"the hung cloth is not stable: its softest eigenvalue is {softest:.2g} 1/s^2"
    return Hung(cloth.positions, tilt, 1 if cloth.positions[:, 0].mean() >= 0.0 else -1, softest, reason)


def motion_of(cloth: Cloth, floor: list[Body], held: Floats, tilt: Tilt, fixed: Floats | None = None) -> Motion:
    """Return what drives the cloth after the holders have started; gravity is upright one second after the drop.

    Args:
        cloth: Of one sheet, or of two, the lower of which is fixed.
        floor: What is below.
        held: (K, 3) where the holders start [m].
        tilt: Of gravity, on the first sheet.
        fixed: (F, 3) held vertices that stay [m].
    """
    stay = np.empty((0, 3)) if fixed is None else fixed

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        upright = min(max(time - duration_of(DROP), 0.0), 1.0)
        gravity = np.tile([0.0, 0.0, -GRAVITY], (len(cloth.mesh.rest), 1))
        gravity[: len(tilt.of_vertices), 0] = tilt.of_vertices * GRAVITY * (1.0 - upright)
        x, z = holder_path(time)
        return gravity, np.concatenate([held + np.array([x, 0.0, z]), stay]), floor

    return motion


def landing_offset(path: Floats, held: NDArray[np.intp]) -> float:
    """Return the mean x of the cloth less that of its holders [m] in the first frame after the drop, or NaN."""
    frame = int(np.ceil(duration_of(DROP) * FRAME_RATE))
    if frame >= len(path):
        return float("nan")
    return float(path[frame, :, 0].mean() - path[frame, held, 0].mean())


def frames_checked(frames: int, vertices: int) -> None:
    """Refuse what no scene on this stage can be.

    Raises:
        ValueError: An argument breaks its rule.
    """
    if not 1 <= frames <= FRAMES:
        raise ValueError(f"frames: must be 1 ... {FRAMES}, got {frames}")
    if vertices < 5:
        raise ValueError(f"vertices: must be at least 5, got {vertices}")


def run(
    cloth: Cloth,
    mesh: meshes.Mesh,
    hung: Hung,
    motion: Motion,
    *,
    frames: int,
    contact_force: Callable[[Cloth], Floats],
    on_frame: Callable[[int, int], None] | None = None,
) -> DropAndDrag:
    """Drive a cloth that is in its first state, frame by frame.

    Args:
        cloth: Whose first sheet is held by the holders; what follows is the stage's.
        mesh: Of the first sheet.
        hung: The first sheet as it hangs.
        motion: See `motion_of`.
        frames: To simulate, the first state for one.
        contact_force: What is below on the first sheet [N].
        on_frame: Called with (frames done, frames) after every frame.
    """
    held, count = held_by_holders(mesh), len(mesh.rest)
    weight = cloth.masses[:count].sum() * np.array([0.0, 0.0, -GRAVITY])
    positions, contact, holders = [cloth.positions], [np.zeros(3)], [-weight]
    for frame in range(1, frames):
        cloth.advance(frame / FRAME_RATE, motion)
        contact.append(contact_force(cloth))
        holders.append(cloth.reactions[held].sum(axis=0))
        positions.append(cloth.positions)
        if on_frame is not None:
            on_frame(frame + 1, frames)
        if not np.isfinite(positions[-1]).all():
            break
    everything = np.stack(positions)
    path = everything[:, :count]
    finite = bool(np.isfinite(path).all())
    reason = hung.reason or cloth.why_invalid(everything)
    landed = landing_offset(path, held)
    return DropAndDrag(
        positions=path,
        others=everything[:, count:],
        rest=mesh.rest,
        triangles=mesh.triangles,
        times=np.arange(len(path)) / FRAME_RATE,
        contact_force=np.stack(contact),
        holder_force=np.stack(holders),
        self_intersections=np.array([self_intersections(p, mesh.triangles) if finite else 0 for p in path], np.int32),
        bias_side=hung.tilt.side,
        bias=hung.tilt.bias,
        hung_side=hung.side,
        hung_softest=hung.softest,
        landed_side=int(np.sign(landed)) if np.isfinite(landed) else 0,
        landed_offset=landed,
        least_distance=cloth.least_distance,
        kernel=cloth.kernel,
        steps=cloth.steps,
        unconverged_steps=cloth.unconverged_steps,
        worst_residual=cloth.worst_residual,
        valid=not reason,
        reason=reason,
    )
