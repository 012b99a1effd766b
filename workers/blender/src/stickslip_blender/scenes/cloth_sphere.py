"""The scene of the turning sphere [thesis, 4.6]: a square of cloth over a ball that stands on the floor."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from stickslip_blender.cloth.clips import render_clips
from stickslip_blender.cloth.geometry import Faces, Prop
from stickslip_blender.workshop import Workshop

if TYPE_CHECKING:
    from stickslip_schemas.documents.tasks import RenderTask, TaskResult
    from stickslip_schemas.kinds.cloth_sphere import ClothSphereRender

RADIUS = 0.05
"""Of the sphere in the simulation [m]."""
SEEN = RADIUS - 0.0005
"""Of the sphere in the picture [m]: half a thickness below the middle surface of a cloth that lies on it."""
SETTLING, FRAMES_PER_SECOND = 2.0, 15.0
"""How long the sphere rests and then gains its speed [s], and how many instants a second has, as in the simulation."""
_GORES, _RINGS = 32, 16
_COLORS = (
    (0.06, 0.06, 0.06),
    (0.4, 0.4, 0.4),
)  # linear; gores by turns, so that the turning shows, and grey: see the gate

Array = npt.NDArray[np.float64]


def render(look: ClothSphereRender, task: RenderTask, workshop: Workshop) -> TaskResult:
    """Render the clips of a cloth on a turning sphere."""
    make = partial(Ball, angular_speed=look.angular_speed)
    return render_clips(look, task, workshop, make, surroundings_key=look.angular_speed)


def turned(instant: int, angular_speed: float) -> float:
    """Return the angle by which the sphere has turned at an instant [rad], as `turned` of the simulation has it."""
    t = max(instant / FRAMES_PER_SECOND - SETTLING, 0.0)
    return angular_speed * (0.5 * t * t / SETTLING if t < SETTLING else t - 0.5 * SETTLING)


class Ball:
    """A ball of gores in two colours; the lamp points at its top."""

    def __init__(self, _rest: npt.ArrayLike, *, angular_speed: float) -> None:
        self._speed = angular_speed
        parts = zip(_gores(), _COLORS, strict=True)
        self.props = tuple(Prop(f"ball-{n}", *part, color, 0.5) for n, (part, color) in enumerate(parts, 1))

    def placed(self, instant: int, _vertices: Array) -> list[Array]:
        """Turn the ball to where it is at an instant."""
        angle = turned(instant, self._speed)
        c, s = np.cos(angle), np.sin(angle)
        turn, center = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([0.0, 0.0, RADIUS])
        return [prop.vertices @ turn.T + center for prop in self.props]

    def aim(self, _instant: int, _vertices: Array) -> Array:
        """Return the middle of the ball."""
        return np.array([0.0, 0.0, RADIUS])


def _gores() -> list[tuple[Array, Faces]]:
    """Return the vertices and faces of both halves of the gores of a ball about the origin."""
    polar = np.pi * np.arange(_RINGS + 1) / _RINGS
    azimuth = 2.0 * np.pi * np.arange(_GORES) / _GORES
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    vertices = SEEN * np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1).reshape(-1, 3)
    halves: tuple[Faces, Faces] = ([], [])
    for ring in range(_RINGS):
        for gore in range(_GORES):
            left, right = ring * _GORES + gore, ring * _GORES + (gore + 1) % _GORES
            halves[gore * 8 // _GORES % 2].append((left, left + _GORES, right + _GORES, right))
    return [(vertices, half) for half in halves]
