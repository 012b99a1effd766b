"""Custom scenes: sheets of cloth, bodies that move, and friction between each two."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core._sim_core import sheet_count
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.bodies import Body
from stickslip_sim_core.cloth.contact import THICKNESS, SelfContact, Surface
from stickslip_sim_core.cloth.fabrics import Fabric
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.scenes.holders import Holder
from stickslip_sim_core.scenes.kind import Record
from stickslip_sim_core.scenes.scene import Scene

FRAMES_MAX = 10_000
"""Of a scene."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """One piece of cloth of a scene."""

    mesh: meshes.Mesh
    fabric: Fabric
    positions: ArrayLike
    """(V, 3): where it starts, at rest [m]."""

    holders: Sequence[Holder] = ()
    """Of vertices of the sheet."""

    thickness: float = THICKNESS
    """[m]"""


def scene(
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
) -> Scene:
    """Return a scene with contact within and between sheets, and with bodies and surfaces. Nothing in it crosses.

    Its run records `contact_force`, of bodies, surfaces and other sheets on each sheet, and `holder_force`, of its
    holders: (frames, S, 3) [N].

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

    Raises:
        ValueError: An argument breaks its rule.
    """
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
    holders = [
        replace(holder, vertices=np.asarray(holder.vertices) + begin)
        for sheet, begin in zip(sheets, ends, strict=False)
        for holder in sheet.holders
    ]
    mesh = meshes.together(*(sheet.mesh for sheet in sheets))
    weight = np.tile(down, (len(mesh.rest), 1))

    def motion(time: float) -> tuple[Floats, Sequence[Body]]:
        return weight, bodies(time) if callable(bodies) else bodies

    return Scene(
        mesh=mesh,
        fabrics=[sheet.fabric for sheet in sheets],
        preset=preset_named(preset),
        start=np.concatenate(starts),
        motion=motion,
        frames=frames,
        frame_rate=frame_rate,
        holders=holders,
        self_contact=SelfContact(np.asarray(friction, float).reshape(len(sheets), -1), [s.thickness for s in sheets]),
        surfaces=surfaces,
        forces=lambda cloth: _forces(cloth, ends),
        kernel=kernel,
    )


def _forces(cloth: Cloth, ends: NDArray[np.int64]) -> Record:
    """Return the forces [N] on each sheet, whose vertices lie between two `ends`: (S, 3)."""
    is_held = np.zeros(len(cloth.masses), dtype=bool)
    is_held[cloth.held] = True
    pairs, reactions = cloth.pair_forces, cloth.reactions
    contact, holders = [], []
    for begin, end in pairwise(ends.tolist()):
        own, fixed = reactions[begin:end], is_held[begin:end]
        share = (pairs.weights * ((pairs.vertices >= begin) & (pairs.vertices < end))).sum(axis=1)
        contact.append(own[~fixed].sum(axis=0) + share @ pairs.forces)
        holders.append(own[fixed].sum(axis=0))
    return {"contact_force": np.stack(contact), "holder_force": np.stack(holders)}
