"""Styles of rendered clips: texture, lamp, exposure, noise and errors of the registration.

A style is sampled for every clip that a network trains on. Objects about the cloth are in
`surroundings`.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

TEXTURE_SIZE = 56
"""Points along a side of a texture, and of the refined mesh that carries it."""

BLOT_CELLS = 17
"""Cells of the noise along a side of a texture with blots, at most."""


@dataclass(frozen=True)
class Style:
    """The style of B clips of F frames: every tensor has one row a clip."""

    texture: Tensor
    """(B, N, N): reflectance of the points of the cloth, 0 to 1."""
    lamp: Tensor
    """(B, 3): direction to the lamp."""
    ambient: Tensor
    """(B,): light from all around, over that of the lamp."""
    exposure: Tensor
    """(B,)"""
    floor: Tensor
    """(B,): brightness of the background."""
    gamma: Tensor
    """(B,): exponent of brightness to grey level."""
    blur: Tensor
    """(B,): standard deviation [px]."""
    noise: Tensor
    """(B,): standard deviation of grey levels."""
    shift: Tensor
    """(B, F, 2) [px]: error of the registration of the holders."""
    stretch: Tensor
    """(B,): the scale over that of the crop."""


def sample_style(clips: int, frames: int, generator: torch.Generator) -> Style:
    """Sample the style of some clips of some frames each."""

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(clips, *shape, generator=generator)

    # The order of the calls is part of what a seed means.
    azimuth = torch.deg2rad(uniform(-110, 50))
    elevation = torch.deg2rad(uniform(32, 72))
    lamp = torch.stack(
        [
            torch.cos(elevation) * torch.cos(azimuth),
            torch.cos(elevation) * torch.sin(azimuth),
            torch.sin(elevation),
        ],
        -1,
    )
    # The registration wanders from frame to frame about an error that stays.
    wander = 0.25 * torch.randn(clips, frames, 2, generator=generator)
    steady = 0.4 * torch.randn(clips, 1, 2, generator=generator)
    return Style(
        texture=sample_textures(clips, generator),
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


def sample_textures(clips: int, generator: torch.Generator) -> Tensor:
    """Sample reflectances of cloth, (clips, TEXTURE_SIZE, TEXTURE_SIZE).

    A texture is plain, or has stripes, checks, dots, blots, or a mixture of them.
    """
    axis = torch.linspace(0, 1, TEXTURE_SIZE)
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    random = torch.rand(14, clips, 1, 1, generator=generator)
    first = _stripes(u, v, random[0:5])
    second = _stripes(u, v, random[5:10])

    cells = torch.randint(5, 18, (clips, 1), generator=generator).expand(-1, 2)
    noise = torch.rand(clips, BLOT_CELLS, BLOT_CELLS, generator=generator)
    blots = torch.sigmoid(12 * (enlarged(noise, cells, TEXTURE_SIZE) - 0.5))

    patterns = torch.stack(
        [
            torch.full_like(first, 0.5),  # plain
            first,  # stripes
            first * second,  # dots
            torch.maximum(first, second),  # a grid
            0.5 * (first + second),  # checks
            blots,
        ]
    )
    kind = (6 * random[10, :, 0, 0]).long()
    pattern = patterns[kind, torch.arange(clips)]

    # Two reflectances, the darker one first; half of the patterns are inverted.
    darker = 0.12 + 0.75 * random[11:13].amin(dim=0)
    brighter = 0.12 + 0.75 * random[11:13].amax(dim=0)
    is_upright = random[13] < 0.5
    return darker + (brighter - darker) * torch.where(is_upright, pattern, 1 - pattern)


def _stripes(u: Tensor, v: Tensor, random: Tensor) -> Tensor:
    """Return stripes, 0 to 1, of any direction, width and sharpness.

    `random` has five numbers a clip, 0 to 1, (5, clips, 1, 1).
    """
    direction, is_oblique, frequency, phase, sharpness = random
    # Most stripes run along an edge of the cloth.
    angle = math.pi * torch.where(is_oblique < 0.4, direction, direction.round() / 2)
    across = u * torch.cos(angle) + v * torch.sin(angle)
    wave = torch.sin(2 * math.pi * ((3 + 14 * frequency**2) * across + phase))
    return torch.sigmoid((1 + 12 * sharpness) * (wave - 0.6 * (phase - 0.5)))


def enlarged(noise: Tensor, cells: Tensor, points: int) -> Tensor:
    """Enlarge a part of noise (B, n, n) smoothly to (B, points, points).

    The part is the first `cells` of each clip, (B, 2) rows and columns.
    """
    fraction = (cells - 1) / (noise.shape[1] - 1)
    down, along = (torch.linspace(0, 2, points) * fraction[..., None] - 1).unbind(1)
    columns = along[:, None].expand(-1, points, -1)
    rows = down[..., None].expand(-1, -1, points)
    grid = torch.stack([columns, rows], dim=-1)
    enlarged = functional.grid_sample(
        noise[:, None], grid, mode="bicubic", padding_mode="border", align_corners=True
    )
    return enlarged[:, 0]
