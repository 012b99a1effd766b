"""Scenes as data: the first sheet takes the axis `texture`, everything else is a prop."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stickslip_schemas.spec.appearance import CLIP_SIZE

from stickslip_blender.cloth.clips import picture, render_clips
from stickslip_blender.cloth.stage import Stage, first_sheet
from stickslip_blender.workshop import Workshop

if TYPE_CHECKING:
    from stickslip_schemas.documents.tasks import RenderTask, TaskResult
    from stickslip_schemas.kinds.cloth_scene import ClothSceneRender


def render(look: ClothSceneRender, task: RenderTask, workshop: Workshop) -> TaskResult:
    """Render the clips of a scene."""
    scene = look.scene.model_dump(mode="json")
    stage = Stage(scene, workshop.record(task.record), lambda name: picture(name, workshop))
    return render_clips(
        look,
        task,
        workshop,
        lambda _rest: stage,
        sheet=f"{first_sheet(scene)}.",
        frame=lambda geometry: stage.camera(look.viewpoint, geometry, CLIP_SIZE),
    )
