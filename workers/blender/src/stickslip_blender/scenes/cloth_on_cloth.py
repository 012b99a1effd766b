"""The scene of cloth on cloth [thesis, 4.2.2]: as drop-and-drag, over a floor that looks woven.

The stretched cloth is shown as a woven floor: in the simulation it stays flat, and moves by less than a pixel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from stickslip_blender.cloth.clips import render_clips
from stickslip_blender.cloth.geometry import Holders
from stickslip_blender.workshop import Workshop

if TYPE_CHECKING:
    from stickslip_schemas.documents.tasks import RenderTask, TaskResult
    from stickslip_schemas.kinds.cloth_on_cloth import ClothOnClothRender


def render(look: ClothOnClothRender, task: RenderTask, workshop: Workshop) -> TaskResult:
    """Render the clips of a cloth that is dragged over cloth."""
    return render_clips(look, task, workshop, Holders)
