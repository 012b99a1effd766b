"""A hanging silicone rod under soft lights, in front of a dark ground, in all cameras of its rig.

No clamp is in the picture: the rod begins at its first point. To recover the centreline from an
image (thesis 5.3.1), threshold against the ground. Every bright pixel is rod.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from stickslip_schemas.documents.tasks import RenderOutput, TaskResult
from stickslip_schemas.format.pictures import png
from stickslip_schemas.spec.cameras import Camera, rig_cameras
from stickslip_schemas.spec.jobs import Quality

from stickslip_blender.cycles.engine import SAMPLING, Sampling, new_scene, set_sampling
from stickslip_blender.cycles.objects import (
    SoftBox,
    add_material,
    add_mesh,
    add_view,
    move_mesh,
    panorama,
    set_environment,
    set_inputs,
    set_view,
)
from stickslip_blender.cycles.pixels import FrameReader, encode
from stickslip_blender.raster import fans, projected, see, window_about
from stickslip_blender.render_context import RenderContext, why_unfit

if TYPE_CHECKING:
    from stickslip_schemas.documents.tasks import RenderTask
    from stickslip_schemas.kinds.rod_hang import RodHangRender

SIDES = 24  # a 24-gon is at most 0.9 % of the radius inside its circle
CAP_RINGS = 4  # rings of the half sphere on the free end, without its pole

FloatArray = npt.NDArray[np.float64]


def transport_frames(tangents: FloatArray) -> FloatArray:
    """Carry a normal along unit tangents (n, 3) without twist.

    Return (n, 2, 3), two unit normals at each point.

    From point to point, the frame turns by the least rotation that takes the tangent t to t'. For a
    normal n, this is n' = n - (n . t') (t + t') / (1 + t . t').
    """
    normals = np.empty_like(tangents)
    axis = np.eye(3)[np.argmin(np.abs(tangents[0]))]
    normal = axis - (axis @ tangents[0]) * tangents[0]
    normals[0] = normal / np.linalg.norm(normal)
    for i in range(1, len(tangents)):
        before = tangents[i - 1]
        here = tangents[i]
        normal = normals[i - 1] - (normals[i - 1] @ here) / (1.0 + before @ here) * (before + here)
        normal -= (normal @ here) * here  # rounding would add up
        normals[i] = normal / np.linalg.norm(normal)
    return np.stack([normals, np.cross(tangents, normals)], axis=1)


def tube_vertices(centerline: FloatArray, radius: float) -> FloatArray:
    """Return the vertices of the tube about a centreline (n, 3).

    The shape is (n SIDES + CAP_RINGS SIDES + 2, 3). The order is: n rings, the rings of the round
    end, its pole, and the middle of the flat end in the clamp.
    """
    tangents = np.gradient(centerline, axis=0, edge_order=2)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normals = transport_frames(tangents)
    angle = 2.0 * np.pi / SIDES * np.arange(SIDES)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)  # (SIDES, 2)
    rings = centerline[:, None] + radius * circle @ normals  # (n, SIDES, 3)
    # Make the rings of the half sphere on the free end, each smaller and farther along the tangent.
    rise = np.pi / 2.0 / (CAP_RINGS + 1) * np.arange(1, CAP_RINGS + 1)[:, None, None]
    cap = centerline[-1] + radius * (
        np.cos(rise) * (circle @ normals[-1]) + np.sin(rise) * tangents[-1]
    )
    pole = centerline[-1] + radius * tangents[-1]
    return np.concatenate([rings.reshape(-1, 3), cap.reshape(-1, 3), pole[None], centerline[:1]])


def tube_faces(points: int) -> list[tuple[int, ...]]:
    """Return the faces of the tube about a centreline, as vertex indices.

    Their normals point outward.
    """
    rings = points + CAP_RINGS
    pole = rings * SIDES
    middle = rings * SIDES + 1
    faces: list[tuple[int, ...]] = []
    # Make quadrilaterals between neighbouring rings, then fans to the pole and to the flat end.
    for ring in range(rings - 1):
        for side in range(SIDES):
            a = ring * SIDES + side
            b = ring * SIDES + (side + 1) % SIDES
            faces.append((a, b, b + SIDES, a + SIDES))
    for side in range(SIDES):
        a = side
        b = (side + 1) % SIDES
        faces.append(((rings - 1) * SIDES + a, (rings - 1) * SIDES + b, pole))
        faces.append((b, a, middle))
    return faces


POINTS = 150
RADIUS = 0.008  # [L], the default
GROUND = 0.0025  # linear light of the dark ground
GROUND_LEVEL = 8  # the same in a picture, from 0 to 255

# Strong and weak lights alternate, high up. Each of the four views of rod-4 has a lit and a shaded
# side.
AMBIENT = 0.2
SOFT_BOXES = (
    SoftBox(azimuth=40.0, elevation=40.0, radiance=2.4, sharpness=4.0),
    SoftBox(azimuth=160.0, elevation=25.0, radiance=0.9, sharpness=4.0),
    SoftBox(azimuth=270.0, elevation=40.0, radiance=2.1, sharpness=4.0),
)

Color = tuple[float, float, float]


def silicone_color(seed: int) -> Color:
    """Draw a bright, saturated color, sRGB in [0, 1], rounded to 1/255.

    The hue is uniform, the HSV saturation is in [0.55, 0.95], and the value is in [0.7, 1].
    """
    hue, saturation, value = np.random.Generator(np.random.PCG64(seed)).random(3)
    color = colorsys.hsv_to_rgb(hue, 0.55 + 0.4 * saturation, 0.7 + 0.3 * value)
    red, green, blue = (round(channel * 255) / 255 for channel in color)
    return red, green, blue


def to_linear(color: Color) -> Color:
    """Decode sRGB [IEC 61966-2-1] to linear light, the unit of Blender's shaders."""
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in color)
    return red, green, blue


class RodRenderer:
    """A scene with one rod, built once.

    Only vertices, color and camera change between frames.
    """

    def __init__(self, *, quality: Quality | Sampling = Quality.standard) -> None:
        self._scene = new_scene()
        self._sampling = quality if isinstance(quality, Sampling) else SAMPLING[quality]
        set_sampling(self._scene, self._sampling)
        set_environment(self._scene, panorama(SOFT_BOXES, AMBIENT), GROUND)
        straight = np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), POINTS)
        faces = tube_faces(POINTS)
        self._mesh = add_mesh(self._scene, "rod", tube_vertices(straight, RADIUS), faces)
        self._triangles = fans(faces)
        self._shader = add_material(
            self._mesh, "silicone", Roughness=0.3, IOR=1.41
        )  # vinyl polysiloxane
        add_view(self._scene)
        self._reader = FrameReader(self._scene)

    def render(
        self,
        centerline: npt.ArrayLike,
        cameras: Sequence[Camera],
        *,
        color: Color,
        radius: float = RADIUS,
        seed: int = 0,
    ) -> npt.NDArray[np.uint8]:
        """Render a centreline (points, 3) [L] with each camera: 8-bit sRGB.

        The shape is (cameras, height, width, 3). `seed` is added to the seed of the sampling, so
        pictures of a dataset differ in their noise.
        """
        line = np.asarray(centerline, dtype=np.float64)
        if line.shape != (POINTS, 3) or not np.isfinite(line).all():
            raise ValueError(
                f"centerline must be finite, of shape ({POINTS}, 3); got shape {line.shape}"
            )
        if not 0.0 < radius < 0.1:
            raise ValueError(f"radius must be in (0, 0.1) L; got {radius}")
        vertices = tube_vertices(line, radius).astype(np.float32)
        move_mesh(self._mesh, vertices)
        self._scene.cycles.seed = self._sampling.seed + seed
        set_inputs(self._shader, Base_Color=(*to_linear(color), 1.0))
        return np.stack([self._view(vertices, camera) for camera in cameras])

    def _view(self, vertices: npt.NDArray[np.float32], camera: Camera) -> npt.NDArray[np.uint8]:
        """Render the window around the rod, and fill the rest with ground."""
        set_view(self._scene, camera)
        frame = np.full((camera.height, camera.width, 3), GROUND_LEVEL, dtype=np.uint8)
        points = projected(camera, vertices)
        window = window_about(points, camera)
        if window.area:
            visible = see(points, self._triangles, window)
            light = self._reader.read_matte(window).astype(np.float32)
            frame[window.slices] = encode(
                self._before_ground(light, visible.share_below(len(self._triangles)))
            )
        return frame

    def _before_ground(
        self, light: npt.NDArray[np.float32], coverage: npt.NDArray[np.float32]
    ) -> npt.NDArray[np.float32]:
        """Put the light of the rod (h, w, 4) before the ground.

        The last channel of the light is the share of samples that hit the rod.

        Most noise on a thin rod comes from the number of samples that hit it. So the code takes the
        mean light of the hits, together with one sample's worth of the pixels around. This mean
        gets the coverage (h, w) that the rasteriser computes.
        """
        # Sum the light and the hits of the 3 x 3 pixels around each pixel.
        padded = np.pad(light, ((1, 1), (1, 1), (0, 0)))
        rows, columns = coverage.shape
        shifted = [
            padded[down : down + rows, across : across + columns]
            for down, across in product(range(3), repeat=2)
        ]
        around = np.sum(shifted, axis=0)

        # Their mean counts as one more sample that hit, because a pixel at the edge may have no hit
        # itself.
        hit = around[..., 3:] > 0.0
        prior = around / np.where(hit, around[..., 3:], 1.0) / self._sampling.samples
        mean = (light + prior)[..., :3] / np.where(hit, (light + prior)[..., 3:], 1.0)

        # Use the exact coverage instead of the share of hits, which is noisy.
        alpha = np.where(hit, coverage[..., None], 0.0)
        return np.asarray(alpha * mean + (1.0 - alpha) * np.float32(GROUND), dtype=np.float32)


def render(appearance: RodHangRender, task: RenderTask, context: RenderContext) -> TaskResult:
    """Render the views of a rod."""
    cameras = rig_cameras(appearance.rig, appearance.resolution)
    line = context.record(task.record)["centerline"]
    if rejected := why_unfit("rod", line, appearance.radius, cameras):
        return rejected
    color = silicone_color(appearance.color_seed)
    renderer = context.renderer(
        ("rod_hang", appearance.quality), lambda: RodRenderer(quality=appearance.quality)
    )
    # The seed of the colour is also the seed of the noise, so rods of a dataset differ in both.
    views = renderer.render(
        line, cameras, color=color, radius=appearance.radius, seed=appearance.color_seed
    )
    preview = (
        context.store.publish(png(np.concatenate(list(views), axis=1))) if task.preview else None
    )
    chunks = {"views": context.chunk(views)}
    labels = {"color": list(to_linear(color))}
    return TaskResult(
        outcome="succeeded", output=RenderOutput(chunks=chunks, preview=preview, labels=labels)
    )
