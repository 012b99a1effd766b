"""The drag scene [thesis, 4.2.3]: a square of cloth that hangs between two holders."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stickslip_blender.cloth.geometry import Holders
from stickslip_blender.cloth.render_task import render_clips
from stickslip_blender.render_context import RenderContext

if TYPE_CHECKING:
    from stickslip_schemas.documents.tasks import RenderTask, TaskResult
    from stickslip_schemas.kinds.cloth_drag import ClothDragRender


def render(appearance: ClothDragRender, task: RenderTask, context: RenderContext) -> TaskResult:
    """Render the clips of a drag."""
    return render_clips(appearance, task, context, Holders)
