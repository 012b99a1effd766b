"""What is compiled beside the rasteriser, against numpy."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from stickslip_blender.cloth.shading import CAMERA_ALBEDOS, ELSEWHERE, FINE, TOLERANCE
from stickslip_blender.raster import Window, _raster

ALBEDOS = CAMERA_ALBEDOS[1], ELSEWHERE[1], ELSEWHERE[2]
RANDOM = np.random.Generator(np.random.PCG64(0))


def _srgb(light: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    bounded = np.clip(light, 0.0, 1.0)
    return 255.0 * np.where(
        bounded <= 0.0031308, 12.92 * bounded, 1.055 * bounded ** (1.0 / 2.4) - 0.055
    )


def test_composed_pictures_are_what_the_formula_says() -> None:
    """In double precision: gloss, light once and twice scattered, in parts of pixels."""
    height, width, count = 9, 12, 3
    window, around = Window(1, 1, 4, 4).times(FINE), Window(5, 3, 12, 9)
    gloss, once, twice = RANDOM.uniform(-0.02, 0.4, (3, FINE * height, FINE * width))
    covered = np.zeros(gloss.shape, dtype=bool)
    covered[window.slices] = chosen = RANDOM.random((6, 6)) < 0.7
    here = np.where(covered, once, 0.0)  # off the cloth nothing is seen of its albedo
    light = np.stack(
        [
            gloss + here * a + twice * b * np.where(covered, a, 1.0)
            for a, b in zip(CAMERA_ALBEDOS, ELSEWHERE, strict=True)
        ],
        axis=-1,
    ).astype(np.float16)
    coverage = RANDOM.uniform(0.1, 1.0, (6, 6)).astype(np.float32) * chosen
    visibility, reflected, overall = (
        RANDOM.uniform(0.0, 1.0, shape).astype(np.float32) for shape in [(6, 6, 9), (6, 7, 9), (9,)]
    )
    floor = RANDOM.uniform(0.5, 1.5, (height, width, 3)).astype(np.float32)
    pictures = np.empty((count, 2, height, width, 3), dtype=np.uint8)[:, 1]
    _raster.compose(
        light.view(np.uint16),
        ALBEDOS,
        overall,
        coverage,
        visibility,
        window.place,
        reflected,
        around.place,
        floor,
        pictures,
    )

    at = np.moveaxis(light.astype(np.float64), -1, 0)[..., None]
    slope = (at[1] - at[2]) / (ALBEDOS[1] - ALBEDOS[2])
    around_it = np.tile(overall.astype(np.float64), (*gloss.shape, 1))
    around_it[around.times(FINE).slices] = reflected.repeat(FINE, 0).repeat(FINE, 1)
    cover, over = np.zeros((*gloss.shape, 1)), np.zeros_like(around_it)
    cover[window.slices], over[window.slices] = coverage[..., None], visibility
    of_cloth = at[0] + (at[1] - at[0] + slope * (overall - ALBEDOS[1])) * over / ALBEDOS[0]
    expected = np.where(cover > 0.0, of_cloth, at[1] + slope * (around_it - ALBEDOS[1]))
    expected = expected.reshape(*gloss.shape, count, 3)
    expected *= (1.0 + (1.0 - cover) * (floor.repeat(FINE, 0).repeat(FINE, 1) - 1.0))[:, :, None]
    expected = np.moveaxis(
        expected.reshape(height, FINE, width, FINE, count, 3).mean(axis=(1, 3)), 2, 0
    )
    np.testing.assert_allclose(pictures, _srgb(expected), atol=1.1)


def test_levels_are_near_the_exact_values_and_those_of_grey_are_equal() -> None:
    """Nearly grey light keeps its hue within a level.

    Colours that differ are rounded; a level that is near stays.
    """
    random = np.random.Generator(np.random.PCG64(4))
    overall = np.array([0.5, 0.51, 0.49, 0.9, 0.2, 0.5], dtype=np.float32)
    light = random.uniform(0.0, 0.6, (24, 60)).astype(np.float16)
    shading = np.stack([(a * light).astype(np.float16) for a in ELSEWHERE], axis=-1)
    nothing, nowhere = np.empty((0, 0), dtype=np.float32), (0, 0, 0, 0)
    pictures = np.zeros((2, 24, 60, 3), dtype=np.uint8)
    none = np.empty((0, 0, 6), dtype=np.float32)
    floor = np.ones((24, 60, 3), dtype=np.float32)
    _raster.compose(
        shading.view(np.uint16),
        ALBEDOS,
        overall,
        nothing,
        none,
        nowhere,
        none,
        nowhere,
        floor,
        pictures,
    )
    exact = _srgb(light[..., None].astype(np.float64) * overall)
    grey, colorful = pictures
    assert np.abs(grey - exact[..., :3]).max() <= TOLERANCE + 0.2
    assert np.abs(colorful - exact[..., 3:]).max() <= 0.9
    hues, rounded = (
        np.ptp(picture, axis=-1) for picture in (grey.astype(int), np.rint(exact[..., :3]))
    )
    assert (hues == 0).mean() > (rounded == 0).mean() + 0.2

    brighter, fresh, cached = (
        (np.float16(1.01) * shading).view(np.uint16),
        np.zeros_like(pictures),
        pictures.copy(),
    )
    for composed in (fresh, cached):
        _raster.compose(
            brighter, ALBEDOS, overall, nothing, none, nowhere, none, nowhere, floor, composed
        )
    stays = (cached == pictures).all(axis=-1)
    exact = np.stack(
        np.split(_srgb(1.01 * light[..., None].astype(np.float64) * overall), 2, axis=-1)
    )
    assert np.abs(cached - exact).max() <= TOLERANCE + 0.3
    assert np.array_equal(cached[~stays], fresh[~stays])
    assert stays.mean() > (fresh == pictures).all(axis=-1).mean() + 0.2


def _side(inside: Any, middle: int, radius: float) -> npt.NDArray[np.float64]:
    """Return the shares of cells that a side of a box covers, about the middle of one of them."""
    half = np.sqrt(0.25 + radius**2)
    low, high = middle + 0.5 - half, middle + 0.5 + half
    covered: npt.NDArray[np.float64] = np.clip(
        np.minimum(inside + 1, high) - np.maximum(inside, low), 0.0, 1.0
    )
    return covered / (2.0 * half)


def test_blurring_is_a_box_twice() -> None:
    height, width = 7, 9
    values = RANDOM.uniform(0.0, 1.0, (height, width, 2)).astype(np.float32)
    down, across = (RANDOM.uniform(0.0, 2.5, (height, width)).astype(np.float32) for _ in range(2))
    down[2, 3] = across[2, 3] = 0.0
    expected = values.astype(np.float64)
    for _ in range(2):
        blurred = np.empty_like(expected)
        for row, column in np.ndindex(height, width):
            box = np.outer(
                _side(np.arange(height), row, down[row, column]),
                _side(np.arange(width), column, across[row, column]),
            )
            blurred[row, column] = np.einsum("hw,hwk->k", box, expected)
        expected = blurred
    np.testing.assert_allclose(_raster.blurred(values, down, across), expected, atol=1e-6)
    with pytest.raises(ValueError, match="radii must be at least 0"):
        _raster.blurred(values, down - 1.0, across)


def test_normals_point_off_the_surface() -> None:
    """Of a strip of a cylinder, its radii; a vertex of no triangle has none."""
    angle, height = np.meshgrid(np.linspace(0.0, 1.0, 41), np.linspace(0.0, 0.2, 9), indexing="ij")
    points = np.stack([np.cos(angle), np.sin(angle), height], axis=-1).reshape(-1, 3)
    number = np.arange(41 * 9).reshape(41, 9)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]
    triangles = np.concatenate(
        [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([b, d, c], axis=-1).reshape(-1, 3)]
    )
    normals = _raster.normals(
        np.concatenate([points, [[9.0, 9.0, 9.0]]]), triangles.astype(np.int32)
    )
    inner = number[1:-1, 1:-1].ravel()
    np.testing.assert_allclose(normals[inner], (points * [1.0, 1.0, 0.0])[inner], atol=1e-3)
    assert not normals[-1].any()
