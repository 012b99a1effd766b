"""The rod scene: one silicone rod hanging before a dark ground, under soft lights.

There is no clamp in the picture: the rod begins at its first point. Whoever goes from image back to centreline (thesis
5.3.1) thresholds against the ground, and every bright pixel should then be rod.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera, load_rig
from stickslip_schemas.spec.jobs import Quality

from stickslip_blender.blender import import_bpy
from stickslip_blender.color import Color, silicone_color, to_linear
from stickslip_blender.engine import SAMPLING, Sampling, new_scene, set_sampling
from stickslip_blender.environment import SoftBox, panorama, set_environment
from stickslip_blender.multiplexed import encode
from stickslip_blender.pixels import FrameReader, Window
from stickslip_blender.preview import side_by_side
from stickslip_blender.raster import projected, see
from stickslip_blender.tube import tube_faces, tube_vertices
from stickslip_blender.view import new_view, set_view
from stickslip_blender.workshop import Workshop, why_unfit

if TYPE_CHECKING:
    from stickslip_schemas.documents.tasks import RenderTask, TaskResult
    from stickslip_schemas.kinds.rod_hang import RodHangRender

POINTS = 150
RADIUS = 0.008  # [L], the default
GROUND = 0.0025  # linear light of the dark ground
GROUND_LEVEL = 8  # the same in a picture, of 255

# Strong and weak by turns, high up: each of the four views of rod-4 has a lit and a shaded side.
AMBIENT = 0.2
SOFT_BOXES = (
    SoftBox(azimuth=40.0, elevation=40.0, radiance=2.4, sharpness=4.0),
    SoftBox(azimuth=160.0, elevation=25.0, radiance=0.9, sharpness=4.0),
    SoftBox(azimuth=270.0, elevation=40.0, radiance=2.1, sharpness=4.0),
)


def render(look: RodHangRender, task: RenderTask, workshop: Workshop) -> TaskResult:
    """Render the views of one rod."""
    cameras = load_rig(look.rig)
    (line,) = workshop.record(task.record, "centerline")
    if rejected := why_unfit("rod", line, look.radius, cameras):
        return rejected
    color = silicone_color(look.color_seed)
    renderer = workshop.renderer(
        ("rod_hang", look.quality), lambda: RodRenderer(quality=look.quality, scratch=workshop.scratch)
    )
    views = renderer.render(line, cameras, color=color, radius=look.radius, seed=look.color_seed)
    return workshop.rendered(
        "views", views, side_by_side(views) if task.preview else None, {"color": list(to_linear(color))}
    )


class RodRenderer:
    """A rod scene, built once; only vertices, color and camera change between frames.

    Blender is one scene per process: a second renderer in the same process would empty the first.
    """

    def __init__(
        self,
        *,
        quality: Quality | Sampling = Quality.standard,
        points: int = POINTS,
        scratch: str | Path | None = None,
    ) -> None:
        self._scene = new_scene()
        self._sampling = quality if isinstance(quality, Sampling) else SAMPLING[quality]
        set_sampling(self._scene, self._sampling)
        self._scene.cycles.max_bounces = 2
        self._scene.cycles.diffuse_bounces = 1
        self._scene.cycles.glossy_bounces = 1
        set_environment(self._scene, panorama(SOFT_BOXES, AMBIENT), GROUND)
        self._points = points
        self._mesh = _add_rod(self._scene, points)
        self._triangles = _triangles(tube_faces(points))
        self._shader = _add_silicone(self._mesh)
        new_view(self._scene)
        self._reader = FrameReader(self._scene, scratch)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of what it holds outside Blender."""
        self._reader.close()

    def render(
        self,
        centerline: npt.ArrayLike,
        cameras: Sequence[Camera],
        *,
        color: Color,
        radius: float = RADIUS,
        seed: int = 0,
    ) -> npt.NDArray[np.uint8]:
        """Render a centreline (points, 3) [L] with each camera: 8-bit sRGB, shape (cameras, height, width, 3).

        Seed: added to that of the sampling, so that noise is not the same in every picture of a dataset.
        """
        line = np.asarray(centerline, dtype=np.float64)
        if line.shape != (self._points, 3) or not np.isfinite(line).all():
            raise ValueError(f"centerline must be finite, of shape ({self._points}, 3); got shape {line.shape}")
        if not 0.0 < radius < 0.1:
            raise ValueError(f"radius must be in (0, 0.1) L; got {radius}")
        vertices = tube_vertices(line, radius).astype(np.float32)
        self._mesh.attributes["position"].data.foreach_set("vector", vertices.ravel())
        self._mesh.update()
        self._scene.cycles.seed = self._sampling.seed + seed
        self._shader.inputs["Base Color"].default_value = (*to_linear(color), 1.0)
        return np.stack([self._view(vertices, camera) for camera in cameras])

    def _view(self, vertices: npt.NDArray[np.float32], camera: Camera) -> npt.NDArray[np.uint8]:
        """Render the window that the rod is in; the rest is ground."""
        set_view(self._scene, camera)
        frame = np.full((camera.height, camera.width, 3), GROUND_LEVEL, dtype=np.uint8)
        window = _window_about(vertices, camera)
        if not window.is_empty:
            seen = see(projected(camera, vertices), self._triangles, window)
            light = self._reader.read_matte(window).astype(np.float32)
            frame[window.slices] = encode(self._before_ground(light, seen.share_below(len(self._triangles))))
        return frame

    def _before_ground(
        self, light: npt.NDArray[np.float32], coverage: npt.NDArray[np.float32]
    ) -> npt.NDArray[np.float32]:
        """Put the light of the rod, (h, w, 4) with the share of samples that hit it, before the ground.

        What is noisy on a thin rod is how many samples hit it. So the mean light of those that did, helped by one
        sample's worth of the pixels around, is given the coverage (h, w) that our rasteriser finds.
        """
        padded = np.pad(light, ((1, 1), (1, 1), (0, 0)))
        rows, columns = coverage.shape
        around = np.sum([padded[r : r + rows, c : c + columns] for r in range(3) for c in range(3)], axis=0)
        hit = around[..., 3:] > 0.0
        help_ = around / np.where(hit, around[..., 3:], 1.0) / self._sampling.samples
        mean = (light + help_)[..., :3] / np.where(hit, (light + help_)[..., 3:], 1.0)
        share = np.where(hit, coverage[..., None], 0.0)
        return np.asarray(share * mean + (1.0 - share) * np.float32(GROUND), dtype=np.float32)


def _triangles(faces: Sequence[Sequence[int]]) -> npt.NDArray[np.int32]:
    fans = [(face[0], face[k], face[k + 1]) for face in faces for k in range(1, len(face) - 1)]
    return np.array(fans, dtype=np.int32)


def _window_about(vertices: npt.NDArray[np.float32], camera: Camera) -> Window:
    pixels, _ = camera.project(vertices)
    left, top = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 1, 0)
    right, bottom = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 2, (camera.width, camera.height))
    return Window(int(left), int(top), int(right), int(bottom))


def _add_rod(scene: Any, points: int) -> Any:
    bpy = import_bpy()
    mesh = bpy.data.meshes.new("rod")
    straight = np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), points)
    mesh.from_pydata(tube_vertices(straight, RADIUS).tolist(), [], tube_faces(points))
    mesh.shade_smooth()
    scene.collection.objects.link(bpy.data.objects.new("rod", mesh))
    return mesh


def _add_silicone(mesh: Any) -> Any:
    """Give the mesh a vinyl polysiloxane look; return the shader, whose base color is to be set."""
    material = import_bpy().data.materials.new("silicone")
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = 0.3
    shader.inputs["IOR"].default_value = 1.41  # vinyl polysiloxane
    mesh.materials.append(material)
    return shader
