"""What a render process holds: it takes render tasks in JSON form and answers in JSON form.

Nothing here knows of Ray. What is wrong with the sample is a rejection in the answer; what is wrong with anything else
is raised, and whoever runs the process knows what to make of it. Results appear in the store by renaming whole files:
a crash of Blender leaves nothing that could be taken for one.
"""

from __future__ import annotations

import io
import time
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.cameras import Camera, load_rig, rig_digest
from stickslip_schemas.chunks import encode_chunk
from stickslip_schemas.jobs import Quality
from stickslip_schemas.states import Reason
from stickslip_schemas.store import Store
from stickslip_schemas.tasks import ChunkRef, RecordRef, RenderOutput, RenderTask, RodRender, TaskResult

from stickslip_blender.build import blender_version, build_digest
from stickslip_blender.color import silicone_color, to_linear
from stickslip_blender.preview import side_by_side
from stickslip_blender.rods import RodRenderer

FRAME_MARGIN = 1.0
"""How far inside the frame a rod has to stay [px]."""


class RenderActor:
    """Renders samples from the store into the store. One to a process: Blender is one scene."""

    def __init__(self, store_root: str, scratch: str | None = None) -> None:
        self._store = Store(store_root)
        self._scratch = scratch
        self._renderer: tuple[Quality, RodRenderer] | None = None
        self._centerlines: tuple[str, npt.NDArray[np.float32]] = ("", np.empty(0, dtype=np.float32))

    def close(self) -> None:
        """Let go of what the renderer holds outside Blender."""
        if self._renderer is not None:
            self._renderer[1].close()
            self._renderer = None

    def describe(self) -> dict[str, Any]:
        """Say which renderer this is; the same for every process of one build."""
        return {"build": build_digest(), "kinds": ["rod_hang"], "versions": blender_version()}

    def render(self, task: dict[str, Any]) -> dict[str, Any]:
        """Render the sample of a `RenderTask`; return a `TaskResult`."""
        wall, cpu = time.perf_counter(), time.process_time()
        job = RenderTask.model_validate(task)
        if not isinstance(job.render, RodRender):
            raise ValueError(f"render.kind must be rod_hang; got {job.render.kind!r}")
        result = self._rod(job.render, job.record, preview=job.preview)
        spent = {"cpu_seconds": time.process_time() - cpu, "wall_seconds": time.perf_counter() - wall}
        return result.model_copy(update=spent).model_dump(mode="json")

    def _rod(self, look: RodRender, record: RecordRef, *, preview: bool) -> TaskResult:
        if look.rig_digest != rig_digest(look.rig):
            raise ValueError(
                f"render.rig_digest must be that of {look.rig} here, {rig_digest(look.rig)}; got {look.rig_digest}"
            )
        cameras = load_rig(look.rig)
        line = self._centerline(record)
        if not np.isfinite(line).all():
            return _rejected(Reason.invalid_sample, "the centreline has values that are not finite")
        if outside := _leaving(line, look.radius, cameras):
            return _rejected(Reason.out_of_frame, outside)
        color = silicone_color(look.color_seed)
        views = self._renderer_for(look.quality).render(line, cameras, color=color, radius=look.radius)
        chunk = encode_chunk(views[None])
        output = RenderOutput(
            chunks={"views": ChunkRef(digest=self._store.publish(chunk), offset=0, length=len(chunk))},
            preview=self._store.publish(side_by_side(views)) if preview else None,
            labels={"color": list(to_linear(color))},
        )
        return TaskResult(outcome="succeeded", output=output)

    def _centerline(self, record: RecordRef) -> npt.NDArray[np.float32]:
        """Return one row of an artifact of rods; the last artifact is kept, for a batch shares one."""
        digest, lines = self._centerlines
        if digest != record.digest:
            with np.load(io.BytesIO(self._store.read(record.digest)), allow_pickle=False) as file:
                lines = file["centerline"]
            self._centerlines = record.digest, lines
        if record.row >= len(lines):
            raise ValueError(f"record.row must be below {len(lines)}, the rows of {record.digest}; got {record.row}")
        line: npt.NDArray[np.float32] = lines[record.row]
        return line

    def _renderer_for(self, quality: Quality) -> RodRenderer:
        if self._renderer is None or self._renderer[0] != quality:
            self.close()
            self._renderer = quality, RodRenderer(quality=quality, scratch=self._scratch)
        return self._renderer[1]


def _leaving(line: npt.NDArray[np.float32], radius: float, cameras: tuple[Camera, ...]) -> str:
    """Say which views the rod leaves and by how much; nothing if it is in all of them."""
    overflow = {camera.name: camera.overflow(line, radius, FRAME_MARGIN) for camera in cameras}
    return "; ".join(
        f"the rod leaves view {name} by {excess:.1f} px" for name, excess in overflow.items() if excess > 0.0
    )


def _rejected(reason: Reason, message: str) -> TaskResult:
    return TaskResult(outcome="rejected", reason=reason, message=message)
