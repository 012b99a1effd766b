"""What a render process holds: it takes render tasks in JSON form and answers in JSON form.

Nothing here knows of Ray. What is wrong with the sample is a rejection in the answer; what is wrong with anything else
is raised, and whoever runs the process knows what to make of it. Results appear in the store by renaming whole files:
a crash of Blender leaves nothing that could be taken for one.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from dataclasses import astuple
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from stickslip_schemas.cameras import Camera, load_rig, rig_digest
from stickslip_schemas.chunks import encode_chunk
from stickslip_schemas.clips import shown_frames
from stickslip_schemas.states import Reason
from stickslip_schemas.store import Store
from stickslip_schemas.tasks import (
    ChunkRef,
    ClothRender,
    RecordRef,
    RenderOutput,
    RenderTask,
    RodRender,
    TaskResult,
)

from stickslip_blender.build import blender_version, build_digest
from stickslip_blender.cloth import ClothRenderer, Light
from stickslip_blender.color import silicone_color, to_linear
from stickslip_blender.preview import side_by_side
from stickslip_blender.rods import RodRenderer

FRAME_MARGIN = 1.0
"""How far inside the frame a rod or a cloth has to stay [px]."""

PREVIEW_FRAMES = 6
"""Frames of a clip that its preview shows, side by side."""

Array = npt.NDArray[Any]
Renderer = TypeVar("Renderer", RodRenderer, ClothRenderer)


class RenderActor:
    """Renders samples from the store into the store. One to a process: Blender is one scene."""

    def __init__(self, store_root: str, scratch: str | None = None) -> None:
        self._store = Store(store_root)
        self._scratch = scratch
        self._renderer: tuple[object, RodRenderer | ClothRenderer] | None = None
        self._records: tuple[str, dict[str, Array]] = ("", {})

    def close(self) -> None:
        """Let go of what the renderer holds outside Blender."""
        if self._renderer is not None:
            self._renderer[1].close()
            self._renderer = None

    def describe(self) -> dict[str, Any]:
        """Say which renderer this is; the same for every process of one build."""
        return {"build": build_digest(), "kinds": ["rod_hang", "cloth_drag"], "versions": blender_version()}

    def render(self, task: dict[str, Any]) -> dict[str, Any]:
        """Render the sample of a `RenderTask`; return a `TaskResult`."""
        wall, cpu = time.perf_counter(), time.process_time()
        job = RenderTask.model_validate(task)
        _check_rig(job.render)
        if isinstance(job.render, RodRender):
            result = self._rod(job.render, job.record, preview=job.preview)
        else:
            result = self._cloth(job.render, job.record, preview=job.preview)
        spent = {"cpu_seconds": time.process_time() - cpu, "wall_seconds": time.perf_counter() - wall}
        return result.model_copy(update=spent).model_dump(mode="json")

    def _rod(self, look: RodRender, record: RecordRef, *, preview: bool) -> TaskResult:
        cameras = load_rig(look.rig)
        (line,) = self._record(record, "centerline")
        if not np.isfinite(line).all():
            return _rejected(Reason.invalid_sample, "the centreline has values that are not finite")
        if outside := _leaving("rod", line, look.radius, cameras):
            return _rejected(Reason.out_of_frame, outside)
        color = silicone_color(look.color_seed)
        renderer = self._renderer_for(
            ("rod", look.quality), lambda: RodRenderer(quality=look.quality, scratch=self._scratch)
        )
        views = renderer.render(line, cameras, color=color, radius=look.radius)
        return self._rendered("views", views, views if preview else None, {"color": list(to_linear(color))})

    def _cloth(self, look: ClothRender, record: RecordRef, *, preview: bool) -> TaskResult:
        (camera,) = (camera for camera in load_rig(look.rig) if camera.name == look.viewpoint)
        track, rest, triangles = self._record(record, "mesh", "rest", "triangles")
        if not np.isfinite(track).all():
            return _rejected(Reason.invalid_sample, "the trajectory has positions that are not finite")
        if outside := _leaving("cloth", track, 0.0, (camera,)):
            return _rejected(Reason.out_of_frame, outside)
        mesh = triangles.tobytes(), rest.tobytes()
        renderer = self._renderer_for(
            ("cloth", look.quality, mesh),
            lambda: ClothRenderer(triangles, rest, quality=look.quality, scratch=self._scratch),
        )
        light = Light.drawn(look.light_seed)
        shown = track[list(shown_frames(look.frames))]
        video = renderer.render(shown, camera, texture=look.texture, light=light)
        few = video[np.linspace(0, len(video) - 1, min(PREVIEW_FRAMES, len(video))).round().astype(int)]
        labels = {"light_seed": look.light_seed, "light": list(astuple(light))}
        return self._rendered("video", video, few if preview else None, labels)

    def _rendered(self, name: str, pictures: Array, preview: Array | None, labels: dict[str, Any]) -> TaskResult:
        """Publish pictures (n, height, width, 3), and some of them as a preview, and return the result."""
        chunk = encode_chunk(pictures[None])
        output = RenderOutput(
            chunks={name: ChunkRef(digest=self._store.publish(chunk), offset=0, length=len(chunk))},
            preview=None if preview is None else self._store.publish(side_by_side(preview)),
            labels=labels,
        )
        return TaskResult(outcome="succeeded", output=output)

    def _record(self, record: RecordRef, *names: str) -> list[Array]:
        """Return one row of arrays of an artifact; the last artifact is kept, for several renders share it."""
        digest, arrays = self._records
        if digest != record.digest:
            with np.load(io.BytesIO(self._store.read(record.digest)), allow_pickle=False) as file:
                arrays = {name: file[name] for name in names}
            self._records = record.digest, arrays
        rows = len(arrays[names[0]])
        if record.row >= rows:
            raise ValueError(f"record.row must be below {rows}, the rows of {record.digest}; got {record.row}")
        return [arrays[name][record.row] for name in names]

    def _renderer_for(self, scene: object, build: Callable[[], Renderer]) -> Renderer:
        """Return the renderer of a scene: the last one, or else another in its place."""
        if self._renderer is None or self._renderer[0] != scene:
            self.close()
            self._renderer = scene, build()
        return self._renderer[1]  # type: ignore[return-value]  # `scene` names what `build` makes


def _check_rig(look: RodRender | ClothRender) -> None:
    if look.rig_digest != rig_digest(look.rig):
        raise ValueError(
            f"render.rig_digest must be that of {look.rig} here, {rig_digest(look.rig)}; got {look.rig_digest}"
        )


def _leaving(what: str, points: Array, radius: float, cameras: tuple[Camera, ...]) -> str:
    """Say which views a thing leaves and by how much; nothing if it is in all of them."""
    overflow = {camera.name: camera.overflow(points, radius, FRAME_MARGIN) for camera in cameras}
    return "; ".join(
        f"the {what} leaves view {name} by {excess:.1f} px" for name, excess in overflow.items() if excess > 0.0
    )


def _rejected(reason: Reason, message: str) -> TaskResult:
    return TaskResult(outcome="rejected", reason=reason, message=message)
