"""The compiled rasteriser against a plain one in numpy, and against what geometry says."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from stickslip_blender.raster import (
    GRID,
    Textures,
    Window,
    _raster,
    barycentric,
    projected,
    see,
    see_albedo,
    window_about,
)
from stickslip_schemas.spec.cameras import load_rig
from stickslip_testing.cameras import looking_at

RANDOM = np.random.Generator(np.random.PCG64(0))


def _soup(
    count: int = 40,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32], npt.NDArray[np.float64]]:
    """Return triangles strewn over and beyond a small picture: projected points, triangles, texture
    coordinates.
    """
    middle = RANDOM.uniform(-3.0, 19.0, (count, 1, 2))
    corners = middle + RANDOM.uniform(-5.0, 5.0, (count, 3, 2))
    depth = RANDOM.uniform(0.5, 3.0, (count, 3, 1))
    points = np.concatenate([corners, depth], axis=2).reshape(-1, 3)
    return (
        points,
        np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        RANDOM.uniform(0.0, 1.0, (3 * count, 2)),
    )


def _places(window: Window, grid: int) -> npt.NDArray[np.float64]:
    """Return the samples, (grid height, grid width, 2) [px]: raster.hpp has the formula."""
    rows, columns = (window.bottom - window.top) * grid, (window.right - window.left) * grid
    shift = (5 * np.arange(grid) % grid + 0.5) / grid
    j, i = np.mgrid[:rows, :columns]
    x = (i + shift[j % grid]) / grid + window.left - 0.5
    y = (j + shift[i % grid]) / grid + window.top - 0.5
    return np.stack([x, y], axis=-1)


def _plain(points: Any, triangles: Any, window: Window, grid: int) -> npt.NDArray[np.int32]:
    places = _places(window, grid)
    flat = places.reshape(-1, 2)
    visibility, nearest = (
        np.full(len(flat), -1, dtype=np.int32),
        np.zeros(len(flat), dtype=np.float32),
    )
    for number, triangle in enumerate(triangles):
        corners = np.broadcast_to(points[triangle][None, :, :2], (len(flat), 3, 2))
        weights = barycentric(corners, flat)
        near = (weights @ (1.0 / points[triangle][:, 2])).astype(np.float32)
        hit = (weights >= 0.0).all(axis=1) & (near > nearest)
        visibility[hit], nearest[hit] = number, near[hit]
    return visibility.reshape(places.shape[:2])


@pytest.mark.parametrize("grid", [1, 4, GRID])
def test_what_is_seen_is_what_a_plain_rasteriser_sees(grid: int) -> None:
    points, triangles, _ = _soup()
    window = Window(2, 1, 15, 12)
    visibility = see(points, triangles, window, grid)
    expected = _plain(points, triangles, window, grid)
    assert (expected >= 0).mean() > 0.3
    assert (
        visibility.triangle != expected
    ).mean() < 1e-3  # of samples that lie on an edge, rounding decides


def _srgb_to_linear(c: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def _looked_up(
    picture: npt.NDArray[np.uint8], uv: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Interpolate between texel centres in sRGB, clamped, and decode."""
    size = len(picture)
    place = np.clip(uv * size - 0.5, 0.0, size - 1.0)
    low = np.minimum(place.astype(int), size - 2)
    share = place - low
    texels = picture / 255.0

    def at(down: int, right: int) -> npt.NDArray[np.float64]:
        return np.asarray(texels[low[:, 1] + down, low[:, 0] + right])

    across, down = share[:, :1], share[:, 1:]
    lower = at(0, 0) * (1 - across) + at(0, 1) * across
    upper = at(1, 0) * (1 - across) + at(1, 1) * across
    return _srgb_to_linear(lower * (1 - down) + upper * down)


def test_albedo_is_the_mean_of_textures_over_what_is_seen() -> None:
    points, triangles, uv = _soup()
    window, grid, end = Window(0, 0, 16, 16), 6, 25
    pictures = [RANDOM.integers(0, 256, (16, 16, 3), dtype=np.uint8) for _ in range(3)]
    visibility = see(points, triangles, window, grid)
    sight = see_albedo(visibility, uv, Textures(pictures), end)
    places = _places(window, grid)
    for row in range(16):
        for column in range(16):
            cell = np.s_[row * grid : (row + 1) * grid, column * grid : (column + 1) * grid]
            number, place = visibility.triangle[cell].ravel(), places[cell].reshape(-1, 2)
            odd = np.indices((grid, grid)).sum(axis=0).ravel() % 2
            hit = (number >= 0) & (number < end)
            assert sight.coverage[row, column] == pytest.approx(hit.mean())
            if not hit.any():
                assert not sight.mean[row, column].any()
                continue
            used = np.flatnonzero(hit)
            used = used[(odd[used] == 0) | (used == used[0])]
            corners = triangles[number[used]]
            weights = barycentric(points[corners][..., :2], place[used]) / points[corners][..., 2]
            weights /= weights.sum(axis=1, keepdims=True)
            where = np.einsum("nk,nkx->nx", weights, uv[corners])
            for texture, picture in enumerate(pictures):
                expected = _looked_up(picture, where).mean(axis=0)
                np.testing.assert_allclose(sight.mean[row, column, texture], expected, atol=1e-4)
    of_sheet = visibility.triangle[(visibility.triangle >= 0) & (visibility.triangle < end)]
    assert np.array_equal(sight.hits, np.bincount(of_sheet, minlength=end))


def test_coverage_of_a_triangle_is_its_area() -> None:
    points = np.array([[1.3, 2.1, 1.0], [27.8, 6.4, 1.0], [9.2, 29.9, 1.0]])
    visibility = see(points, np.array([[0, 1, 2]], dtype=np.int32), Window(0, 0, 32, 32))
    (a, b), (c, d) = points[1, :2] - points[0, :2], points[2, :2] - points[0, :2]
    assert visibility.share_below(1).sum() == pytest.approx(abs(a * d - b * c) / 2, rel=2e-4)


def test_decoding_is_within_its_bound() -> None:
    encoded = np.linspace(0.0, 1.0, 4001)
    error = np.array([_raster.decoded(float(value)) for value in encoded]) - _srgb_to_linear(
        encoded
    )
    assert np.abs(error).max() < 2.2e-5


def test_values_at_centers_are_interpolated_in_perspective() -> None:
    camera = looking_at(
        (0.0, 0.0, 0.0),
        azimuth=10.0,
        elevation=25.0,
        distance=2.0,
        name="a",
        width=64,
        height=48,
        focal=90.0,
    )
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    points = projected(camera, corners)
    window = window_about(points, camera)
    visibility = see(points, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32), window, grid=1)
    places = visibility.at_centers(np.column_stack([corners, points[:, 2]]), fill=np.nan)
    rows, columns = np.nonzero(visibility.triangle >= 0)
    interpolated = places[rows, columns]
    assert len(interpolated) > 300
    pixels, depth = camera.project(
        interpolated[:, :3]
    )  # the place on the square that a pixel sees projects onto the pixel
    np.testing.assert_allclose(
        pixels, np.column_stack([columns + window.left, rows + window.top]), atol=1e-9
    )
    np.testing.assert_allclose(depth, interpolated[:, 3], atol=1e-9)


def test_a_triangle_that_reaches_behind_the_camera_is_not_seen() -> None:
    points, triangles, _ = _soup(2)
    window = Window(0, 0, 64, 64)
    behind = see(np.where(np.arange(6)[:, None] == 4, -1.0, points), triangles, window).triangle
    alone = see(points[:3], triangles[:1], window).triangle
    np.testing.assert_array_equal(behind, alone)
    assert window_about(np.full((3, 3), np.nan), load_rig("drag")[0]).area == 0


def test_what_cannot_be_drawn_is_refused() -> None:
    points, triangles, _ = _soup(2)
    with pytest.raises(ValueError, match="indices must be from 0 to 5"):
        see(points, triangles + 1, Window(0, 0, 4, 4))
    with pytest.raises(ValueError, match="must be pictures of one shape"):
        Textures([np.zeros((4, 4, 3), np.uint8), np.zeros((8, 8, 3), np.uint8)])
