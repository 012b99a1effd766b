"""Triangulations of rectangles: what they cover, how they are numbered, and what is refused."""

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.meshes import Mesh

Floats = NDArray[np.float64]

MESHES = {
    "alternating": meshes.grid(0.02, 0.1, 4, 20),
    "left": meshes.grid(0.02, 0.1, 4, 20, "left"),
    "right": meshes.grid(0.02, 0.1, 4, 20, "right"),
    "random": meshes.grid(0.02, 0.1, 4, 20, "random", 3),
    "unstructured 0": meshes.unstructured(0.02, 0.1, 0.005, 0),
    "unstructured 1": meshes.unstructured(0.02, 0.1, 0.005, 1),
}


def areas(mesh: Mesh) -> Floats:
    a, b, c = (mesh.rest[mesh.triangles[:, i]] for i in range(3))
    u, v = b - a, c - a
    twice: Floats = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    return 0.5 * twice


@pytest.mark.parametrize("name", MESHES)
class TestEvery:
    def test_covers_the_rectangle_counter_clockwise(self, name: str) -> None:
        mesh = MESHES[name]
        assert areas(mesh).min() > 0.0
        assert areas(mesh).sum() == pytest.approx(0.02 * 0.1, rel=1e-12)
        assert mesh.rest.min(axis=0) == pytest.approx([-0.01, -0.05])
        assert mesh.rest.max(axis=0) == pytest.approx([0.01, 0.05])

    def test_is_a_disc(self, name: str) -> None:
        """Euler: vertices - edges + triangles = 1, and every vertex is used."""
        mesh = MESHES[name]
        edges = {frozenset((int(t[i]), int(t[i - 1]))) for t in mesh.triangles for i in range(3)}
        assert len(mesh.rest) - len(edges) + len(mesh.triangles) == 1
        assert set(mesh.triangles.ravel().tolist()) == set(range(len(mesh.rest)))

    def test_rim(self, name: str) -> None:
        mesh = MESHES[name]
        on_side = np.abs(np.abs(mesh.rest) - [0.01, 0.05]) < 1e-9
        assert mesh.rim.tolist() == np.flatnonzero(on_side.any(axis=1)).tolist()

    def test_spacing(self, name: str) -> None:
        assert MESHES[name].spacing == pytest.approx(0.005, rel=0.12)


def test_grid_is_numbered_row_by_row() -> None:
    mesh = meshes.grid(2.0, 3.0, 2, 3)
    assert mesh.rest[:4].tolist() == [[-1.0, -1.5], [0.0, -1.5], [1.0, -1.5], [-1.0, -0.5]]
    assert len(mesh.triangles) == 12
    assert mesh.spacing == pytest.approx(1.0)


def test_diagonals_differ() -> None:
    patterns = [
        MESHES[name].triangles.tolist() for name in ("alternating", "left", "right", "random")
    ]
    assert all(patterns[i] != patterns[j] for i in range(4) for j in range(i))


def test_seeds() -> None:
    first, again, other = (meshes.unstructured(0.1, 0.1, 0.01, seed) for seed in (5, 5, 6))
    assert (first.rest == again.rest).all()
    assert (first.triangles == again.triangles).all()
    assert (first.rest != other.rest).any()
    random = [meshes.grid(0.1, 0.1, 5, 5, "random", seed).triangles.tolist() for seed in (1, 1, 2)]
    assert random[0] == random[1] != random[2]


def test_unstructured_is_delaunay() -> None:
    """No vertex lies inside the circle through the corners of a triangle."""
    mesh = meshes.unstructured(0.05, 0.05, 0.005, 2)
    for triangle in mesh.triangles:
        a, b, c = mesh.rest[triangle]
        centre = np.linalg.solve(2.0 * np.stack([b - a, c - a]), [b @ b - a @ a, c @ c - a @ a])
        further = np.delete(np.arange(len(mesh.rest)), triangle)
        assert np.linalg.norm(mesh.rest[further] - centre, axis=1).min() > np.linalg.norm(
            a - centre
        ) * (1.0 - 1e-6)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_bad_sizes(value: float) -> None:
    with pytest.raises(ValueError, match="width: must be finite and > 0"):
        meshes.grid(value, 1.0, 2, 2)
    with pytest.raises(ValueError, match="length: must be finite and > 0"):
        meshes.unstructured(1.0, value, 0.1)
    with pytest.raises(ValueError, match="spacing: must be finite and > 0"):
        meshes.unstructured(1.0, 1.0, value)


def test_bad_counts_and_patterns() -> None:
    with pytest.raises(ValueError, match="columns: must be finite and > 0, got 0"):
        meshes.grid(1.0, 1.0, 0, 2)
    with pytest.raises(ValueError, match="rows: must be finite and > 0, got -1"):
        meshes.grid(1.0, 1.0, 2, -1)
    with pytest.raises(
        ValueError, match="diagonals: must be alternating, left, right or random, got 'up'"
    ):
        meshes.grid(1.0, 1.0, 2, 2, "up")  # type: ignore[arg-type]


def test_sheets_lie_side_by_side() -> None:
    a, b = meshes.grid(0.1, 0.2, 3, 4), meshes.unstructured(0.05, 0.05, 0.01, 2)
    both = meshes.together(a, b)
    assert both.triangles[: len(a.triangles)] == pytest.approx(a.triangles)
    assert both.triangles[len(a.triangles) :] - len(a.rest) == pytest.approx(b.triangles)
    first, second = both.rest[: len(a.rest)], both.rest[len(a.rest) :]
    assert second[:, 0].min() > first[:, 0].max()
    assert np.ptp(second - b.rest, axis=0) == pytest.approx([0.0, 0.0], abs=1e-15)
    assert np.ptp(first - a.rest, axis=0) == pytest.approx([0.0, 0.0], abs=1e-15)
