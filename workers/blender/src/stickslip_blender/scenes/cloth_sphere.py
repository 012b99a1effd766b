"""The scene of the turning sphere [thesis, 4.6]: a square of cloth over a ball that stands on the floor."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from stickslip_blender.cloth.clips import render_clips
from stickslip_blender.cloth.geometry import Holders, Prop
from stickslip_blender.cloth.shapes import Faces
from stickslip_blender.workshop import Workshop

if TYPE_CHECKING:
    from stickslip_schemas.documents.tasks import RenderTask, TaskResult
    from stickslip_schemas.kinds.cloth_sphere import ClothSphereRender

SUNK = 0.0005
"""Distance of the visible ball from the sphere of the simulation [m]: half the thickness of a cloth that lies on it."""
_GORES, _RINGS = 32, 16
_COLORS = (
    (0.06, 0.06, 0.06),
    (0.4, 0.4, 0.4),
)  # linear; alternating gores show the rotation; grey: see the gate

Array = npt.NDArray[np.float64]


def render(look: ClothSphereRender, task: RenderTask, workshop: Workshop) -> TaskResult:
    """Render the clips of a cloth on a turning sphere."""
    poses = workshop.record(task.record)["sphere_pose"]
    return render_clips(look, task, workshop, partial(Ball, poses=poses))


class Ball(Holders):
    """A ball of gores in two colours; the lamp points at its centre."""

    def __init__(self, _rest: npt.ArrayLike, *, poses: npt.ArrayLike) -> None:
        """Take the pose of the sphere at each instant (instants, 3, 4), x -> A x + b [m]; it stands on the floor."""
        self._poses = np.asarray(poses, dtype=np.float64)
        radius = float(self._poses[0, 2, 3])
        parts = zip(_gores(radius - SUNK), _COLORS, strict=True)
        self.props = tuple(Prop(f"ball-{n}", *part, np.array([color]), 0.5) for n, (part, color) in enumerate(parts, 1))

    def placed(self, instant: int, _vertices: Array) -> list[Array]:
        """Turn the ball to its pose at an instant."""
        pose = self._poses[instant]
        return [prop.vertices @ pose[:, :3].T + pose[:, 3] for prop in self.props]

    def aim(self, instant: int, _vertices: Array) -> Array:
        """Return the centre of the ball."""
        center: Array = self._poses[instant, :, 3]
        return center


def _gores(radius: float) -> list[tuple[Array, Faces]]:
    """Return the vertices and faces of both halves of the gores of a ball about the origin."""
    polar = np.pi * np.arange(_RINGS + 1) / _RINGS
    azimuth = 2.0 * np.pi * np.arange(_GORES) / _GORES
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    vertices = radius * np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1).reshape(-1, 3)
    halves: tuple[Faces, Faces] = ([], [])
    for ring in range(_RINGS):
        for gore in range(_GORES):
            left, right = ring * _GORES + gore, ring * _GORES + (gore + 1) % _GORES
            halves[gore * 8 // _GORES % 2].append((left, left + _GORES, right + _GORES, right))
    return [(vertices, half) for half in halves]
