"""Renderer of cloth meshes in torch, for the pictures that a network trains on.

The mesh is refined to a grid of points, a little closer together than pixels of the crop. Each
visible point adds its brightness to the four pixels about it. Its weight there is bilinear, times
the area a that the point stands for. With w the weight, and c the brightness of the point,

    alpha = min(1, sum_i w_i a_i),   picture = sum_i w_i a_i c_i / sum_i w_i a_i

and the picture lies over the background by alpha, so an edge moves through a pixel as smoothly as
it does in a photograph. A point is visible if nothing on its pixel is nearer by more than `LAYER`.
The light is one distant lamp and some light from all around.

    style          texture, lamp, exposure, noise        sampled
    surroundings   floor, shadows, holders, codec        sampled; without them the floor is dark
    render_crops   mesh -> cloth layer -> picture
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from scipy.interpolate import CubicHermiteSpline
from torch import Tensor

from stickslip_training.cloth.crop import HEIGHT, WIDTH, Cameras, Crops, holder_crops
from stickslip_training.cloth.style import TEXTURE_SIZE, Style
from stickslip_training.cloth.surroundings import (
    DRAG_MIDDLE,
    ClothLayer,
    Surroundings,
    apply_codec,
    blurred,
    composite,
)

LAYER = 0.012
"""Points nearer than this behind the nearest one on a pixel are of the same layer [m]."""

TURN_CENTER = (DRAG_MIDDLE, 0.0, 0.05)
"""The point about which cameras are rotated, in the middle of the drag scene [m]."""

# ---- Cameras
# --------------------------------------------------------------------------------------------------


def rotate_cameras(cameras: Cameras, azimuth: Tensor, elevation: Tensor) -> Cameras:
    """Rotate cameras about the middle of the drag scene.

    The angles (B,) [rad] are about the vertical, and up.
    """
    middle = cameras.translation.new_tensor(TURN_CENTER).expand(len(azimuth), 3)
    in_camera = (cameras.rotation @ middle[..., None])[..., 0] + cameras.translation
    zero = torch.zeros_like(azimuth)
    unit = torch.ones_like(azimuth)

    # About the vertical axis of the world, and then about the horizontal axis of the camera.
    cos, sin = torch.cos(azimuth), torch.sin(azimuth)
    around = torch.stack([cos, sin, zero, -sin, cos, zero, zero, zero, unit], dim=-1)
    cos, sin = torch.cos(elevation), torch.sin(elevation)
    up = torch.stack([unit, zero, zero, zero, cos, -sin, zero, sin, cos], dim=-1)
    rotation = up.reshape(-1, 3, 3) @ cameras.rotation @ around.reshape(-1, 3, 3)

    # The middle of the scene stays in its place in the picture.
    translation = in_camera - (rotation @ middle[..., None])[..., 0]
    return Cameras(rotation, translation, cameras.focal, cameras.center)


def jitter_cameras(cameras: Cameras, deviation: float, generator: torch.Generator) -> Cameras:
    """Rotate each camera by random angles of this standard deviation [degree]."""
    angles = deviation * torch.randn(2, len(cameras.focal), generator=generator)
    azimuth, elevation = torch.deg2rad(angles)
    return rotate_cameras(cameras, azimuth, elevation)


# ---- Pictures
# --------------------------------------------------------------------------------------------------


def render_crops(
    positions: Tensor,
    cameras: Cameras,
    instants: tuple[float, ...],
    style: Style,
    generator: torch.Generator | None = None,
    surroundings: Surroundings | None = None,
) -> tuple[Tensor, Tensor]:
    """Render the holder-registered crops of meshes.

    Args:
        positions: Vertices of the meshes, (B, F, side, side, 3) [m].
        cameras: Cameras by which the crops are registered.
        instants: Instant of each of the F frames.
        style: Style of each of the B clips.
        generator: Draws the noise; None adds no noise.
        surroundings: Objects in the picture, and by how much the true cameras differ from
            `cameras`; None leaves a dark floor.

    Returns:
        Grey levels, and the fraction of each pixel that cloth covers, (B, F, 72, 88) each.
    """
    crops = holder_crops(cameras, instants)
    true_cameras = cameras if surroundings is None else surroundings.true_cameras(cameras)
    shade = shading(positions, true_cameras, style)
    has_shadows = surroundings is not None

    # One clip's points fit into the cache of a processor; a GPU takes all clips at once.
    size = 1 if positions.device.type == "cpu" else len(positions)
    layers = []
    for start in range(0, len(positions), size):
        batch = slice(start, start + size)
        view = _View(
            true_cameras[batch], crops[batch].off_by(style.shift[batch], style.stretch[batch])
        )
        layers.append(_cloth_layer(positions[batch], shade[batch], view, style, batch, has_shadows))
    cloth = ClothLayer(
        alpha=torch.cat([layer.alpha for layer in layers]),
        light=torch.cat([layer.light for layer in layers]),
        shadow=torch.cat([layer.shadow for layer in layers]),
    )
    pictures = expose(cloth, true_cameras, crops, instants, style, generator, surroundings)
    return pictures, cloth.alpha


@dataclass(frozen=True)
class _View:
    """The cameras of a batch, and the place of its crops."""

    cameras: Cameras
    crops: Crops


def _cloth_layer(
    positions: Tensor, shade: Tensor, view: _View, style: Style, batch: slice, has_shadows: bool
) -> ClothLayer:
    """Draw the cloth of a batch of clips, and its shadow on the floor."""
    # Positions and light are refined together, so that both are as smooth.
    fields = torch.cat([positions, shade[..., None]], dim=-1)
    fine = refine(fields, TEXTURE_SIZE)
    points = fine[..., :3]
    colors = fine[..., 3] * style.texture[batch, None]
    alpha, light = splat(points, colors, view.cameras, view.crops)

    shadow = torch.zeros(1)
    if has_shadows:
        # The shadow is the cloth, moved along the rays of the lamp down to the floor.
        lamp = style.lamp[batch][:, None, None, None]
        on_floor = points - lamp * (points[..., 2:] / lamp[..., 2:])
        shadow = splat(on_floor, torch.ones_like(colors), view.cameras, view.crops)[0]
    return ClothLayer(alpha, light, shadow)


def expose(
    cloth: ClothLayer,
    cameras: Cameras,
    crops: Crops,
    instants: tuple[float, ...],
    style: Style,
    generator: torch.Generator | None,
    surroundings: Surroundings | None,
) -> Tensor:
    """Return the grey levels that a camera records, (B, F, 72, 88).

    Without surroundings the cloth lies on the dark floor of `style`.
    """
    gamma = style.gamma[:, None, None, None]
    if surroundings is None:
        floor = style.floor[:, None, None, None]
        exposure = style.exposure[:, None, None, None]
        light = exposure * cloth.alpha * cloth.light + (1.0 - cloth.alpha) * floor
    else:
        light = composite(cloth, cameras, crops, instants, style, surroundings).clamp(max=1.0)

    # A camera blurs, adds noise, and compresses, in this order.
    pictures = blurred(light.clamp(min=1e-5) ** gamma, style.blur)
    if generator is not None:
        noise = torch.randn(pictures.shape, generator=generator)
        pictures = pictures + style.noise[:, None, None, None] * noise
    if surroundings is not None:
        pictures = apply_codec(pictures, surroundings.codec)
    return pictures.clamp(0.0, 1.0)


def shading(positions: Tensor, cameras: Cameras, style: Style) -> Tensor:
    """Return the light that vertices send to the camera per reflectance [Lambert].

    Vertices are (B, F, side, side, 3) [m]. Cloth is lit on the side that the camera sees.
    """
    across, along = torch.gradient(positions, dim=(2, 3))
    normal = torch.nn.functional.normalize(torch.linalg.cross(across, along), dim=-1)
    eye = -(cameras.rotation.transpose(1, 2) @ cameras.translation[..., None])[..., 0]
    to_eye = eye[:, None, None, None] - positions
    facing = torch.sign((normal * to_eye).sum(dim=-1))
    lamp = (normal * style.lamp[:, None, None, None]).sum(dim=-1) * facing
    return style.ambient[:, None, None, None] + lamp.clamp(min=0.0)


# ---- Refinement
# --------------------------------------------------------------------------------------------------


def refine(fields: Tensor, points: int) -> Tensor:
    """Refine fields on meshes (B, F, side, side, n) to (B, F, points, points, n), smoothly."""
    weights = _spline(fields.shape[2], points).to(fields.device)
    clips, frames, side, _, count = fields.shape
    # The spline is separable: rows of the grid first, then columns.
    rows = weights @ fields.reshape(clips * frames, side, side * count)
    fine = weights @ rows.reshape(clips * frames * points, side, count)
    return fine.reshape(clips, frames, points, points, count)


@cache
def _spline(nodes: int, points: int) -> Tensor:
    """Return W, (points, nodes): W @ y are values of the Catmull-Rom spline through y."""
    unit = np.eye(nodes)
    spline = CubicHermiteSpline(np.arange(nodes), unit, np.gradient(unit, axis=0))
    return torch.from_numpy(spline(np.linspace(0, nodes - 1, points)).astype(np.float32))


# ---- Points to pixels
# --------------------------------------------------------------------------------------------------


def splat(
    points: Tensor,
    colors: Tensor,
    cameras: Cameras,
    crops: Crops,
    *,
    size: tuple[int, int] = (HEIGHT, WIDTH),
) -> tuple[Tensor, Tensor]:
    """Return the coverage and the colour of each pixel, (B, F, *size).

    Points are (B, F, N, N, 3) [m], with colours (B, F, N, N).
    """
    clips, frames = points.shape[:2]
    height, width = size
    pixels, depth = cameras.project(points)
    positions = crops.of_pixels(pixels)
    area = _areas(positions)

    # A border takes the points out of sight: one pixel before the picture, two after it.
    wide = width + 3
    high = height + 3
    column = positions[..., 0].clamp(-1.0, width)
    row = positions[..., 1].clamp(-1.0, height)
    left = column.floor()
    top = row.floor()
    right = column - left
    down = row - top
    start = (torch.arange(clips * frames) * (wide * high)).reshape(clips, frames, 1, 1)
    corner = start + (top.long() + 1) * wide + left.long() + 1

    # A depth buffer of the nearest pixel of each point decides which points are visible.
    nearest = corner + (right > 0.5) + (down > 0.5) * wide
    total = clips * frames * wide * high
    empty = torch.full((total,), math.inf)
    buffer = empty.scatter_reduce_(0, nearest.reshape(-1), depth.reshape(-1), "amin")
    weight = area * (depth <= buffer[nearest] + LAYER)

    # Each point adds to four pixels, with bilinear weights.
    sums = torch.zeros(2, total)
    for step, bilinear in (
        (0, (1 - right) * (1 - down)),
        (1, right * (1 - down)),
        (wide, (1 - right) * down),
        (wide + 1, right * down),
    ):
        index = (corner + step).reshape(-1)
        added = weight * bilinear
        sums[0].index_add_(0, index, added.reshape(-1))
        sums[1].index_add_(0, index, (added * colors).reshape(-1))
    sums = sums.reshape(2, clips, frames, high, wide)[..., 1:-2, 1:-2]
    return sums[0].clamp(max=1.0), sums[1] / sums[0].clamp(min=1e-6)


def _areas(positions: Tensor) -> Tensor:
    """Return the area that each point of a grid stands for [px^2], (B, F, N, N).

    A point on an edge stands for half of it.
    """
    across, along = torch.gradient(positions, dim=(2, 3))
    area = (across[..., 0] * along[..., 1] - across[..., 1] * along[..., 0]).abs()
    edge = torch.ones(positions.shape[2])
    edge[0] = 0.5
    edge[-1] = 0.5
    return area * edge[:, None] * edge
