"""The drop-and-drag scene [thesis, 4.2.3]: a square of cloth that hangs between two holders."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from stickslip_blender.blender import import_bpy
from stickslip_blender.clips import render_clip
from stickslip_blender.cloth import ClothRenderer, add_object, box, new_material
from stickslip_blender.workshop import Workshop

if TYPE_CHECKING:
    from stickslip_schemas.kinds.cloth_drag import ClothDragRender
    from stickslip_schemas.tasks import RenderTask, TaskResult

_HOLDER = (0.004, 0.01, 0.01)  # [m], in the plane of the cloth as in the simulation
_ROD = (0.003, 0.003, 0.5)  # [m]


def render(look: ClothDragRender, task: RenderTask, workshop: Workshop) -> TaskResult:
    """Render one clip of a dragged cloth."""
    return render_clip(look, task, workshop, DragRenderer)


class DragRenderer(ClothRenderer):
    """The stage with two holders at the upper corners of the cloth."""

    def add_props(self, scene: Any, rest: npt.NDArray[np.float64]) -> None:
        """Add the holders, for a cloth whose held edge is the last one of its rest shape."""
        low, high = rest.min(axis=0), rest.max(axis=0)
        corners = np.array([(low[0], high[1]), (high[0], high[1])])
        self._held = np.abs(rest[:, None] - corners).sum(axis=2).argmin(axis=0)
        inward = np.sign((low + high) / 2 - corners) * _HOLDER[1] / 2
        self._grips = np.pad(inward, ((0, 0), (1, 0)))  # from a corner to the middle of its holder (x, y, z) [m]
        self._holders = [_add_holder(scene) for _ in self._held]

    def place_props(self, _instant: int, vertices: npt.NDArray[np.float64]) -> None:
        """Let the holders follow the corners that they hold."""
        for holder, middle in zip(self._holders, vertices[self._held] + self._grips, strict=True):
            holder.location = middle


def _add_holder(scene: Any) -> Any:
    """Add a clip of one centimetre and the rod it hangs on; it holds a square at a corner of the cloth."""
    bpy = import_bpy()
    metal = bpy.data.materials.get("metal") or new_material(
        "metal", Base_Color=(0.05, 0.05, 0.052, 1.0), Roughness=0.45, Metallic=0.0
    )
    boxes = [box(_HOLDER, (0.0, 0.0, 0.0)), box(_ROD, (0.0, 0.0, _ROD[2] / 2))]
    vertices = np.concatenate([corners for corners, _ in boxes])
    faces = [tuple(8 * number + index for index in face) for number, (_, box) in enumerate(boxes) for face in box]
    return add_object(scene, "holder", vertices, faces, metal)
