"""The scene of the shawl [thesis, 4.6]: a cloth over the shoulders of a figure, whose skin follows its bones."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from stickslip_blender.cloth.clips import render_clips
from stickslip_blender.cloth.geometry import Holders, Prop
from stickslip_blender.workshop import Workshop

if TYPE_CHECKING:
    from stickslip_schemas.documents.tasks import RenderTask, TaskResult
    from stickslip_schemas.kinds.shawl import ShawlRender

SUNK = 0.0005
"""Distance of the visible figure inside the skin of the simulation [m]: half the thickness of a cloth on it."""
_COLOR = (0.18, 0.18, 0.18)  # linear, and grey: see the gate
_AIM = (0.0, 0.0, 0.5)  # [m], its chest

Array = npt.NDArray[np.float64]


def render(look: ShawlRender, task: RenderTask, workshop: Workshop) -> TaskResult:
    """Render the clips of a shawl."""
    record = workshop.record(task.record)
    skin, weights, bones = (record[name].astype(np.float64) for name in ("skin_rest", "skin_weights", "bones"))
    triangles = record["skin_triangles"]
    make = partial(Figure, skin=skin, triangles=triangles, weights=weights, bones=bones)
    return render_clips(look, task, workshop, make)


class Figure(Holders):
    """A figure of one neutral colour; the lamp points at its chest."""

    def __init__(
        self, _rest: npt.ArrayLike, *, skin: Array, triangles: npt.NDArray[np.int32], weights: Array, bones: Array
    ) -> None:
        """Take its skin (N, 3) [m], triangles (T, 3), weights (N, bones), and bones (instants, bones, 3, 4)."""
        self._weights, self._bones = weights, bones
        inner = skin - SUNK * _normals(skin, triangles)
        faces = [tuple(face) for face in triangles.tolist()]
        self.props: tuple[Prop, ...] = (Prop("figure", inner, faces, np.array([_COLOR]), 0.6, is_smooth=True),)

    def placed(self, instant: int, _vertices: Array) -> list[Array]:
        """Move the skin with the bones."""
        at = np.einsum("bij,nj->bni", self._bones[instant, :, :, :3], self.props[0].vertices)
        at += self._bones[instant, :, None, :, 3]
        return [np.einsum("nb,bni->ni", self._weights, at)]

    def aim(self, _instant: int, _vertices: Array) -> Array:
        """Return a point in its chest."""
        return np.array(_AIM)


def _normals(points: Array, triangles: npt.NDArray[np.int32]) -> Array:
    """Return the unit normals (N, 3) of a closed mesh at its vertices, outward."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    normals = np.zeros_like(points)
    np.add.at(normals, triangles.ravel(), np.repeat(np.cross(b - a, c - a), 3, axis=0))
    unit: Array = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return unit
