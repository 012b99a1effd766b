"""Clips of cloth: from a render task to a result, for every scene of cloth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple
from typing import TYPE_CHECKING

import numpy as np
from stickslip_schemas.cameras import load_rig

from stickslip_blender.cloth import ClothRenderer, Light
from stickslip_blender.workshop import Workshop, why_unfit

if TYPE_CHECKING:
    from stickslip_schemas.cloth import ClothRender
    from stickslip_schemas.tasks import RenderTask, TaskResult

PREVIEW_FRAMES = 6
"""Frames of a clip that its preview shows, side by side."""


def render_clip(
    look: ClothRender, task: RenderTask, workshop: Workshop, make: Callable[..., ClothRenderer]
) -> TaskResult:
    """Render a clip with the renderer that `make` builds."""
    (camera,) = (camera for camera in load_rig(look.rig) if camera.name == look.viewpoint)
    track, rest, triangles = workshop.record(task.record, "positions", "rest", "triangles")
    if rejected := why_unfit("cloth", track, 0.0, (camera,)):
        return rejected
    mesh = triangles.tobytes(), rest.tobytes()
    renderer = workshop.renderer(
        (look.kind, look.quality, mesh),
        lambda: make(triangles, rest, quality=look.quality, scratch=workshop.scratch),
    )
    light = Light.drawn(look.light_seed)
    shown = track[list(look.instants)]
    video = renderer.render(shown, camera, texture=look.texture, light=light, instants=look.instants)
    few = video[np.linspace(0, len(video) - 1, min(PREVIEW_FRAMES, len(video))).round().astype(int)]
    labels = {"light_seed": look.light_seed, "light": list(astuple(light))}
    return workshop.rendered("video", video, few if task.preview else None, labels)
