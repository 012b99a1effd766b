"""A scene of the user's own: sheets of cloth, bodies that move, and friction between each two."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core._sim_core import self_intersections, sheet_count
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.bodies import Body
from stickslip_sim_core.cloth.contact import THICKNESS, SelfContact, Surface
from stickslip_sim_core.cloth.fabrics import Fabric
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth

FRAMES_MAX = 10_000
"""Of a scene."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """One piece of cloth of a scene."""

    mesh: meshes.Mesh
    fabric: Fabric
    positions: ArrayLike
    """(V, 3): where it starts, at rest [m]."""

    held: ArrayLike = ()
    """(K,): vertices whose positions are prescribed."""

    held_at: Callable[[float], ArrayLike] | None = None
    """Takes a time [s] and returns the positions of the held vertices (K, 3) [m]; None: they stay."""

    thickness: float = THICKNESS
    """[m]"""


@dataclass(frozen=True, eq=False)
class SceneRun:
    """What became of a scene of S sheets."""

    positions: tuple[Floats, ...]
    """Of each sheet: (frames, V, 3) [m]."""

    times: Floats
    """(frames,) [s]"""

    contact_force: Floats
    """(frames, S, 3) [N]: of bodies, surfaces and other sheets on each sheet."""

    holder_force: Floats
    """(frames, S, 3) [N]: of its holders on each sheet."""

    self_intersections: NDArray[np.int32]
    """(frames,): pairs of triangles of all sheets that cross."""

    least_distance: float
    """Of pieces of cloth that do not hang together, and of cloth and surfaces, at the ends of all steps [m]."""

    kernel: str
    """Level of the solver's kernels: levels differ in the last digits."""

    steps: int
    unconverged_steps: int
    worst_residual: float
    """Largest residual force of a node in any step, in weights of 25 mm^2 of the lightest fabric."""

    valid: bool
    reason: str
    """Why it is not valid, or empty."""


def run_scene(
    sheets: Sequence[Sheet],
    friction: ArrayLike,
    *,
    duration: float,
    frame_rate: float = 30.0,
    bodies: Callable[[float], Sequence[Body]] | Sequence[Body] = (),
    surfaces: Sequence[Surface] = (),
    gravity: ArrayLike = (0.0, 0.0, -GRAVITY),
    preset: str | SolverSettings = "certified",
    kernel: str | None = None,
    on_frame: Callable[[int, int], None] | None = None,
) -> SceneRun:
    """Run a scene. Nothing in it crosses: sheets feel themselves, each other, bodies and surfaces.

    Args:
        sheets: The pieces of cloth, at least one.
        friction: Coefficients of friction of each two sheets, and of each with itself: (S, S), symmetric, 0 ... 10.
        duration: [s], above 0.
        frame_rate: Frames a second; the first is at 0 s, the last at `duration` or just before.
        bodies: Planes, spheres, cylinders and boxes; or a function of the time [s] that returns them, always as many
            and in the same order. A vertex touches the nearest.
        surfaces: Triangles that may move.
        gravity: (3,) [m/s^2].
        preset: Solver settings, or their name.
        kernel: Level of the kernels, see `Cloth`.
        on_frame: Called with (frames done, frames) after every frame.

    Raises:
        ValueError: An argument breaks its rule; or a sheet starts across itself, another or a surface.
    """
    settings = preset_named(preset)
    if not sheets:
        raise ValueError("sheets: must be at least one, got none")
    for name, value in (("duration", duration), ("frame_rate", frame_rate)):
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"{name}: must be finite and > 0, got {value}")
    frames = int(duration * frame_rate * (1.0 + 1e-12)) + 1
    if frames > FRAMES_MAX:
        raise ValueError(f"duration: must give at most {FRAMES_MAX} frames at {frame_rate:g} 1/s, got {frames}")
    down = np.asarray(gravity, float)
    if down.shape != (3,) or not np.isfinite(down).all():
        raise ValueError(f"gravity: must be three finite numbers, got {down.tolist()}")
    starts = [np.asarray(sheet.positions, float) for sheet in sheets]
    for number, (sheet, start) in enumerate(zip(sheets, starts, strict=True)):
        if start.shape != (len(sheet.mesh.rest), 3):
            raise ValueError(f"positions: of sheet {number} must be {(len(sheet.mesh.rest), 3)}, got {start.shape}")
        if sheet_count(sheet.mesh.rest, sheet.mesh.triangles) != 1:
            raise ValueError(f"mesh: of sheet {number} must hang together in one piece")
    ends = np.cumsum([0, *map(len, starts)])
    held = [np.asarray(sheet.held, dtype=np.int64).reshape(-1) for sheet in sheets]
    cloth = Cloth(
        meshes.together(*(sheet.mesh for sheet in sheets)),
        [sheet.fabric for sheet in sheets],
        settings,
        held=np.concatenate([own + begin for own, begin in zip(held, ends, strict=False)]),
        self_contact=SelfContact(np.asarray(friction, float).reshape(len(sheets), -1), [s.thickness for s in sheets]),
        surfaces=surfaces,
        kernel=kernel,
    )
    cloth.set_state(np.concatenate(starts))
    field_of_gravity = np.tile(down, (len(cloth.mesh.rest), 1))

    def motion(time: float) -> tuple[Floats, Floats, Sequence[Body]]:
        at = [
            np.asarray(start[own] if sheet.held_at is None else sheet.held_at(time), float).reshape(-1, 3)
            for sheet, start, own in zip(sheets, starts, held, strict=True)
        ]
        return field_of_gravity, np.concatenate(at), bodies(time) if callable(bodies) else bodies

    positions, contact, holders = [cloth.positions], [np.zeros((len(sheets), 3))], [np.zeros((len(sheets), 3))]
    for frame in range(1, frames):
        cloth.advance(frame / frame_rate, motion)
        positions.append(cloth.positions)
        forces = [_forces(cloth, begin, end) for begin, end in pairwise(ends.tolist())]
        contact.append(np.stack([force for force, _ in forces]))
        holders.append(np.stack([force for _, force in forces]))
        if on_frame is not None:
            on_frame(frame + 1, frames)
        if not np.isfinite(positions[-1]).all():
            break
    path = np.stack(positions)
    finite = bool(np.isfinite(path).all())
    triangles = cloth.mesh.triangles
    reason = cloth.why_invalid(path)
    return SceneRun(
        positions=tuple(np.split(path, ends[1:-1], axis=1)),
        times=np.arange(len(path)) / frame_rate,
        contact_force=np.stack(contact),
        holder_force=np.stack(holders),
        self_intersections=np.array([self_intersections(p, triangles) if finite else 0 for p in path], np.int32),
        least_distance=cloth.least_distance,
        kernel=cloth.kernel,
        steps=cloth.steps,
        unconverged_steps=cloth.unconverged_steps,
        worst_residual=cloth.worst_residual,
        valid=not reason,
        reason=reason,
    )


def _forces(cloth: Cloth, begin: int, end: int) -> tuple[Floats, Floats]:
    """Return the force [N] of all that touches it on a sheet's vertices, and that of its holders."""
    is_held = np.zeros(len(cloth.masses), dtype=bool)
    is_held[cloth.held] = True
    of_bodies = cloth.reactions[begin:end][~is_held[begin:end]].sum(axis=0)
    of_holders = cloth.reactions[begin:end][is_held[begin:end]].sum(axis=0)
    pairs = cloth.pair_forces
    share = (pairs.weights * ((pairs.vertices >= begin) & (pairs.vertices < end))).sum(axis=1)
    return of_bodies + share @ pairs.forces, of_holders
