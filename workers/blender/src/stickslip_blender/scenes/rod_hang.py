"""The scene of a hanging rod, seen by all cameras of its rig."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from stickslip_schemas.documents.tasks import RenderOutput, TaskResult
from stickslip_schemas.format.pictures import png
from stickslip_schemas.spec.cameras import load_rig

from stickslip_blender.rods.renderer import RodRenderer, silicone_color, to_linear
from stickslip_blender.workshop import Workshop, why_unfit

if TYPE_CHECKING:
    from stickslip_schemas.documents.tasks import RenderTask
    from stickslip_schemas.kinds.rod_hang import RodHangRender


def render(look: RodHangRender, task: RenderTask, workshop: Workshop) -> TaskResult:
    cameras = load_rig(look.rig)
    line = workshop.record(task.record)["centerline"]
    if rejected := why_unfit("rod", line, look.radius, cameras):
        return rejected
    color = silicone_color(look.color_seed)
    renderer = workshop.renderer(("rod_hang", look.quality), lambda: RodRenderer(quality=look.quality))
    views = renderer.render(line, cameras, color=color, radius=look.radius, seed=look.color_seed)
    preview = workshop.store.publish(png(np.concatenate(list(views), axis=1))) if task.preview else None
    chunks, labels = {"views": workshop.chunk(views)}, {"color": list(to_linear(color))}
    return TaskResult(outcome="succeeded", output=RenderOutput(chunks=chunks, preview=preview, labels=labels))
