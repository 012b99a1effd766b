"""Polygons are cut into triangles that cover them exactly once, or refused."""

import numpy as np
import numpy.typing as npt
import pytest
from stickslip_schemas.scene import polygons
from stickslip_schemas.scene.errors import UnfitFileError
from stickslip_schemas.scene.polygons import triangulate, weld

Floats = npt.NDArray[np.float64]

# Shapes by the corners of their outline, counterclockwise, and their areas.
SHAPES: dict[str, tuple[list[tuple[float, float]], float]] = {
    "square": ([(0, 0), (1, 0), (1, 1), (0, 1)], 1.0),
    "arrow": ([(0, 0), (2, 1), (0, 2), (0.5, 1)], 1.5),
    "hexagon": ([(2, 0), (3, 0), (4, 1), (3, 2), (2, 2), (1, 1)], 4.0),
    "letter C": ([(0, 0), (4, 0), (4, 1), (1, 1), (1, 3), (4, 3), (4, 4), (0, 4)], 10.0),
    "comb": (
        [
            *((0, 0), (7, 0), (7, 3), (6, 3), (6, 1), (4, 1)),
            *((4, 3), (3, 3), (3, 1), (1, 1), (1, 3), (0, 3)),
        ],
        13.0,
    ),
    "with a corner on an edge": ([(0, 0), (1, 0), (2, 0), (2, 2), (0, 2)], 4.0),
}


def signed_area(points: Floats) -> float:
    """Return the area of a polygon (n, 2), by the shoelace formula."""
    x, y = points.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def random_rotation(seed: int) -> Floats:
    matrix, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return np.asarray(matrix * np.sign(np.linalg.det(matrix)))


def cut(points: Floats) -> npt.NDArray[np.int64]:
    return triangulate(points, np.arange(len(points)), np.array([len(points)]))


@pytest.mark.parametrize("name", SHAPES)
def test_a_shape_is_covered_once_from_every_corner_on(name: str) -> None:
    corners, area = SHAPES[name]
    for first in range(len(corners)):
        outline = np.roll(np.array(corners, dtype=float), first, axis=0)
        triangles = cut(outline)
        # As many triangles as a polygon has, all turned alike, of the right total area: so none
        # overlaps another one or leaves the polygon.
        assert triangles.shape == (len(corners) - 2, 3)
        areas = [signed_area(outline[triangle]) for triangle in triangles]
        assert min(areas) > 0.0
        assert sum(areas) == pytest.approx(area, rel=1e-12)


@pytest.mark.parametrize("name", SHAPES)
def test_a_shape_in_space_is_cut_like_the_flat_one(name: str) -> None:
    outline = np.array(SHAPES[name][0], dtype=float)
    flat = np.column_stack([outline, np.zeros(len(outline))])
    for seed in range(5):
        turned = flat @ random_rotation(seed).T + [1.0, -2.0, 3.0]
        areas = [signed_area(outline[triangle]) for triangle in cut(turned)]
        assert min(areas) > 0.0
        assert sum(areas) == pytest.approx(SHAPES[name][1], rel=1e-9)


def test_random_star_shaped_polygons_are_covered() -> None:
    generator = np.random.default_rng(7)
    for _ in range(100):
        count = int(generator.integers(5, 30))
        angles = 2 * np.pi * (np.arange(count) + generator.uniform(0, 0.8, count)) / count
        radii = generator.uniform(0.2, 1.0, count)[:, None]
        outline = radii * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        outline = np.roll(outline, int(generator.integers(count)), axis=0)
        areas = [signed_area(outline[triangle]) for triangle in cut(outline)]
        assert min(areas) > 0.0
        assert sum(areas) == pytest.approx(signed_area(outline), rel=1e-9)


def test_faces_of_all_sizes_keep_their_order() -> None:
    points = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (2, 0), (2, 1)], dtype=float)
    triangles = triangulate(points, np.array([0, 1, 3, 1, 4, 5, 2, 1, 2, 3]), np.array([3, 4, 3]))
    assert triangles.tolist() == [[0, 1, 3], [1, 4, 5], [1, 5, 2], [1, 2, 3]]


@pytest.mark.parametrize(
    "outline",
    [
        pytest.param([(0, 0), (1, 1), (1, 0), (0, 1)], id="bow tie"),
        pytest.param([(0, 0), (1, 0), (2, 0), (3, 0)], id="line"),
        pytest.param([(0, 0), (2, 0), (2, 2), (0, 2), (0, 0), (1, 1)], id="corner met twice"),
        pytest.param(
            [(np.cos(a), np.sin(a)) for a in 0.8 * np.pi * np.arange(5)], id="five-pointed star"
        ),
    ],
)
def test_a_polygon_that_crosses_itself_is_refused(outline: list[tuple[float, float]]) -> None:
    with pytest.raises(UnfitFileError, match="face 0 must be a polygon that does not cross"):
        cut(np.array(outline, dtype=float))


def test_sizes_of_faces_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.zeros((4, 2))
    with pytest.raises(UnfitFileError, match="3 to 1000 corners, and face 1 has 2"):
        triangulate(points, np.array([0, 1, 2, 0, 1]), np.array([3, 2]))
    monkeypatch.setattr(polygons, "MAX_CORNERS", 3)
    with pytest.raises(UnfitFileError, match="3 to 3 corners, and face 0 has 4"):
        triangulate(points, np.arange(4), np.array([4]))
    monkeypatch.undo()
    monkeypatch.setattr(polygons, "MAX_CUTTING_WORK", 100)
    with pytest.raises(UnfitFileError, match=r"must have triangles: .* not convex"):
        cut(np.array(SHAPES["comb"][0], dtype=float))


def test_vertices_are_welded_in_their_order() -> None:
    same = weld(np.array([[1.0, 2.0], [0.0, 0.0], [1.0, 2.0], [-0.0, 0.0], [3.0, 1.0]]))
    assert same.vertices.tolist() == [0, 1, 4]
    assert same.targets.tolist() == [0, 1, 0, 1, 2]
    apart = weld(np.array([[1.0], [0.0], [np.nextafter(1.0, 2.0)]]))
    assert apart.vertices.tolist() == [0, 1, 2]
