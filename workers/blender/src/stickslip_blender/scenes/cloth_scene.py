"""Scenes as data: one sheet takes the axis `texture`, everything else is a prop."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stickslip_schemas.spec.cameras import Camera

from stickslip_blender.cloth.geometry import Geometry
from stickslip_blender.cloth.render_task import picture, render_clips, rig_camera
from stickslip_blender.cloth.stage import Stage
from stickslip_blender.render_context import RenderContext

if TYPE_CHECKING:
    from stickslip_schemas.documents.tasks import RenderTask, TaskResult
    from stickslip_schemas.kinds.cloth_scene import ClothSceneRender


def render(appearance: ClothSceneRender, task: RenderTask, context: RenderContext) -> TaskResult:
    """Render the clips of a scene."""
    sheet = appearance.scene.textured
    scene = appearance.scene.model_dump(mode="json")
    record = context.record(task.record)
    stage = Stage(scene, sheet, appearance.segments, record, lambda name: picture(name, context))

    def frame(geometry: Geometry) -> Camera:
        return (
            stage.camera(appearance.viewpoint, geometry, appearance.resolution)
            if appearance.rig is None
            else rig_camera(appearance)
        )

    return render_clips(
        appearance, task, context, lambda _rest: stage, sheet=f"{sheet}.", frame=frame
    )
