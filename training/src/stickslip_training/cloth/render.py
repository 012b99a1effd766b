"""Pictures of cloth meshes in torch, made while a network trains: any texture, view and light,
drawn afresh.

The mesh is refined to a grid of points, a little closer together than pixels of the crop. Each
visible point adds its brightness to the four pixels about it, with bilinear weights and in the
measure of the area that it stands for:

    alpha = min(1, sum_i w_i a_i),   picture = sum_i w_i a_i c_i / sum_i w_i a_i  over the background by alpha

so an edge moves through a pixel as smoothly as it does in a photograph. A point is visible where
nothing on its pixel is nearer by more than `LAYER`. Light is one distant lamp and some from all
around. What is about the cloth is in `world`.
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from scipy.interpolate import CubicHermiteSpline

from stickslip_training.cloth.crop import HEIGHT, WIDTH, Cameras, Crops, holder_crops
from stickslip_training.cloth.surroundings import (
    ClothLayer,
    Surroundings,
    apply_codec,
    blurred,
    composite,
    enlarged,
)

POINTS = 56
"""Points along a side of the refined mesh."""

LAYER = 0.012
"""[m]: points nearer than this behind the nearest one on a pixel are of the same layer."""


@dataclass(frozen=True)
class Style:
    """What clips look like; every tensor has one row a clip."""

    texture: torch.Tensor
    """(B, N, N): reflectance of the points of the cloth, 0 to 1."""
    lamp: torch.Tensor
    """(B, 3): direction to the lamp."""
    ambient: torch.Tensor
    """(B,): light from all around, over that of the lamp."""
    exposure: torch.Tensor
    """(B,)"""
    floor: torch.Tensor
    """(B,): brightness of the background."""
    gamma: torch.Tensor
    """(B,): exponent of brightness to grey level."""
    blur: torch.Tensor
    """(B,): standard deviation [px]."""
    noise: torch.Tensor
    """(B,): standard deviation of grey levels."""
    shift: torch.Tensor
    """(B, F, 2) [px]: what the registration of the holders is off."""
    stretch: torch.Tensor
    """(B,): the scale over that of the crop."""


def draw_style(clips: int, frames: int, generator: torch.Generator) -> Style:
    """Draw what clips look like."""

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(clips, *shape, generator=generator)

    azimuth, elevation = torch.deg2rad(uniform(-110, 50)), torch.deg2rad(uniform(32, 72))
    lamp = torch.stack(
        [
            torch.cos(elevation) * torch.cos(azimuth),
            torch.cos(elevation) * torch.sin(azimuth),
            torch.sin(elevation),
        ],
        -1,
    )
    wander = 0.25 * torch.randn(clips, frames, 2, generator=generator)
    steady = 0.4 * torch.randn(clips, 1, 2, generator=generator)
    return Style(
        texture=draw_textures(clips, generator),
        lamp=lamp,
        ambient=uniform(0.1, 0.6),
        exposure=uniform(0.6, 1.5),
        floor=uniform(0.0, 0.04),
        gamma=uniform(0.38, 0.6),
        blur=uniform(0.0, 0.6),
        noise=uniform(0.0, 0.02),
        shift=wander * uniform(0.0, 1.0, 1, 1) + steady * uniform(0.0, 1.0, 1, 1),
        stretch=1.0 + 0.005 * torch.randn(clips, generator=generator),
    )


def draw_textures(clips: int, generator: torch.Generator) -> torch.Tensor:
    """Draw reflectances of cloth, (clips, POINTS, POINTS): plain, stripes, checks, dots, blots, and
    mixtures of them."""
    v, u = torch.meshgrid(torch.linspace(0, 1, POINTS), torch.linspace(0, 1, POINTS), indexing="ij")
    r = torch.rand(14, clips, 1, 1, generator=generator)
    first, second = (_wave(u, v, r[start : start + 5]) for start in (0, 5))
    plain, mean = torch.full_like(first, 0.5), 0.5 * (first + second)
    coarse = torch.randint(5, 18, (clips, 1), generator=generator).expand(-1, 2)
    blots = torch.sigmoid(
        12 * (enlarged(torch.rand(clips, 17, 17, generator=generator), coarse, POINTS) - 0.5)
    )
    sorts = [plain, first, first * second, torch.maximum(first, second), mean, blots]
    pattern = torch.stack(sorts)[(6 * r[10, :, 0, 0]).long(), torch.arange(clips)]
    low, high = 0.12 + 0.75 * r[11:13].amin(dim=0), 0.12 + 0.75 * r[11:13].amax(dim=0)
    return low + (high - low) * torch.where(r[13] < 0.5, pattern, 1 - pattern)


def _wave(u: torch.Tensor, v: torch.Tensor, r: torch.Tensor) -> torch.Tensor:
    """Return stripes, 0 to 1: of any direction, width and sharpness."""
    angle = math.pi * torch.where(r[1] < 0.4, r[0], r[0].round() / 2)
    wave = torch.sin(
        2 * math.pi * ((3 + 14 * r[2] ** 2) * (u * torch.cos(angle) + v * torch.sin(angle)) + r[3])
    )
    return torch.sigmoid((1 + 12 * r[4]) * (wave - 0.6 * (r[3] - 0.5)))


def turned(cameras: Cameras, azimuth: torch.Tensor, elevation: torch.Tensor) -> Cameras:
    """Turn cameras about the middle of the drag scene by angles (B,) [rad]: about the vertical, and
    up.
    """
    middle = cameras.translation.new_tensor([0.15, 0.0, 0.05]).expand(len(azimuth), 3)
    seen = (cameras.rotation @ middle[..., None])[..., 0] + cameras.translation
    c, s, zero, one = (
        torch.cos(azimuth),
        torch.sin(azimuth),
        torch.zeros_like(azimuth),
        torch.ones_like(azimuth),
    )
    around = torch.stack([c, s, zero, -s, c, zero, zero, zero, one], dim=-1).reshape(-1, 3, 3)
    c, s = torch.cos(elevation), torch.sin(elevation)
    up = torch.stack([one, zero, zero, zero, c, -s, zero, s, c], dim=-1).reshape(-1, 3, 3)
    rotation = up @ cameras.rotation @ around
    return Cameras(
        rotation, seen - (rotation @ middle[..., None])[..., 0], cameras.focal, cameras.center
    )


def randomly_turned(cameras: Cameras, deviation: float, generator: torch.Generator) -> Cameras:
    """Turn each camera by angles of its own of this standard deviation [degree]."""
    azimuth, elevation = torch.deg2rad(
        deviation * torch.randn(2, len(cameras.focal), generator=generator)
    )
    return turned(cameras, azimuth, elevation)


def render_crops(
    positions: torch.Tensor,
    cameras: Cameras,
    instants: tuple[float, ...],
    style: Style,
    generator: torch.Generator | None = None,
    world: Surroundings | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Render the holder-registered crops of meshes (B, F, side, side, 3) [m], and how much of each
    pixel cloth covers.

    Both are (B, F, 72, 88), grey levels and shares. `cameras` register the crops; `world` says how
    the true ones differ, and what else is in the picture: without it, nothing but a dark floor.
    `generator` draws the noise; without it there is none.
    """
    crops = holder_crops(cameras, instants)
    true = cameras if world is None else world.true_cameras(cameras)
    shade = shading(positions, true, style)
    parts = []
    count = (
        1 if positions.device.type == "cpu" else len(positions)
    )  # one clip's points fit into a processor's cache
    for clip in range(0, len(positions), count):
        one = slice(clip, clip + count)
        fine = _refined(torch.cat([positions[one], shade[one, ..., None]], dim=-1), POINTS)
        points, colors = fine[..., :3], fine[..., 3] * style.texture[one, None]
        place = true[one], crops[one].off_by(style.shift[one], style.stretch[one])
        lamp = style.lamp[one][:, None, None, None]
        fallen = points - lamp * (points[..., 2:] / lamp[..., 2:])
        shadow = (
            torch.zeros(1) if world is None else splat(fallen, torch.ones_like(colors), *place)[0]
        )
        parts.append((*splat(points, colors, *place), shadow))
    cloth = ClothLayer(*(torch.cat(part) for part in zip(*parts, strict=True)))
    return pictured(cloth, true, crops, instants, style, generator, world), cloth.alpha


def pictured(
    cloth: ClothLayer,
    cameras: Cameras,
    crops: Crops,
    instants: tuple[float, ...],
    style: Style,
    generator: torch.Generator | None,
    world: Surroundings | None,
) -> torch.Tensor:
    """Return the grey levels of cloth in a world, or over the dark floor of `style`, (B, F, 72,
    88).
    """
    if world is None:
        floor = style.floor[:, None, None, None]
        light = (
            style.exposure[:, None, None, None] * cloth.alpha * cloth.light
            + (1.0 - cloth.alpha) * floor
        )
    else:
        light = composite(cloth, cameras, crops, instants, style, world).clamp(max=1.0)
    picture = light.clamp(min=1e-5) ** style.gamma[:, None, None, None]
    picture = blurred(picture, style.blur)
    if generator is not None:
        picture = picture + style.noise[:, None, None, None] * torch.randn(
            picture.shape, generator=generator
        )
    return (picture if world is None else apply_codec(picture, world.codec)).clamp(0.0, 1.0)


def _refined(fields: torch.Tensor, points: int) -> torch.Tensor:
    """Refine fields on meshes (B, F, side, side, n) to (B, F, points, points, n), smoothly."""
    weights = _spline(fields.shape[2], points).to(fields.device)
    clips, frames, side, _, count = fields.shape
    rows = weights @ fields.reshape(clips * frames, side, side * count)
    fine = weights @ rows.reshape(clips * frames * points, side, count)
    return fine.reshape(clips, frames, points, points, count)


@cache
def _spline(nodes: int, points: int) -> torch.Tensor:
    """Return W, (points, nodes): W @ y are values of the Catmull-Rom spline through y."""
    unit = np.eye(nodes)
    spline = CubicHermiteSpline(np.arange(nodes), unit, np.gradient(unit, axis=0))
    return torch.from_numpy(spline(np.linspace(0, nodes - 1, points)).astype(np.float32))


def shading(positions: torch.Tensor, cameras: Cameras, style: Style) -> torch.Tensor:
    """Return the light that vertices (B, F, side, side, 3) send to the camera per reflectance
    [Lambert].
    """
    across, along = torch.gradient(positions, dim=(2, 3))
    normal = torch.nn.functional.normalize(torch.linalg.cross(across, along), dim=-1)
    eye = -(cameras.rotation.transpose(1, 2) @ cameras.translation[..., None])[..., 0]
    facing = torch.sign((normal * (eye[:, None, None, None] - positions)).sum(dim=-1))
    lamp = (normal * style.lamp[:, None, None, None]).sum(dim=-1) * facing
    return style.ambient[:, None, None, None] + lamp.clamp(min=0.0)


def splat(
    points: torch.Tensor,
    colors: torch.Tensor,
    cameras: Cameras,
    crops: Crops,
    *,
    size: tuple[int, int] = (HEIGHT, WIDTH),
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return coverage and colour of each pixel, (B, F, *size), of points (B, F, N, N, 3) with
    colours (B, F, N, N).
    """
    clips, frames = points.shape[:2]
    height, width = size
    pixels, depth = cameras.project(points)
    places = crops.of_pixels(pixels)
    area = _areas(places)
    # A border takes what is out of sight: one pixel before the picture, two after it.
    wide, high = width + 3, height + 3
    column = places[..., 0].clamp(-1.0, width)
    row = places[..., 1].clamp(-1.0, height)
    left, top = column.floor(), row.floor()
    right, down = column - left, row - top
    start = (torch.arange(clips * frames) * (wide * high)).reshape(clips, frames, 1, 1)
    corner = start + (top.long() + 1) * wide + left.long() + 1
    nearest = corner + (right > 0.5) + (down > 0.5) * wide
    total = clips * frames * wide * high
    buffer = torch.full((total,), math.inf).scatter_reduce_(
        0, nearest.reshape(-1), depth.reshape(-1), "amin"
    )
    weight = area * (depth <= buffer[nearest] + LAYER)
    sums = torch.zeros(2, total)
    for step, share in (
        (0, (1 - right) * (1 - down)),
        (1, right * (1 - down)),
        (wide, (1 - right) * down),
        (wide + 1, right * down),
    ):
        place, w = (corner + step).reshape(-1), weight * share
        sums[0].index_add_(0, place, w.reshape(-1))
        sums[1].index_add_(0, place, (w * colors).reshape(-1))
    sums = sums.reshape(2, clips, frames, high, wide)[..., 1:-2, 1:-2]
    return sums[0].clamp(max=1.0), sums[1] / sums[0].clamp(min=1e-6)


def _areas(places: torch.Tensor) -> torch.Tensor:
    """Return the area that each point of a grid stands for [px^2], (B, F, N, N); half of it at
    edges.
    """
    across, along = torch.gradient(places, dim=(2, 3))
    area = (across[..., 0] * along[..., 1] - across[..., 1] * along[..., 0]).abs()
    edge = torch.ones(places.shape[2])
    edge[0] = edge[-1] = 0.5
    return area * edge[:, None] * edge
