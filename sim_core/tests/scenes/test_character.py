"""The figure under the shawl: its skin, its bones and its motion."""

import numpy as np
import pytest

from stickslip_sim_core.scenes import character
from stickslip_sim_core.scenes.character import BONES, EASE, STILL, bones, distance, figure


def _sides(triangles: np.ndarray) -> np.ndarray:
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


class TestSkin:
    def test_it_is_closed_and_faces_outward(self) -> None:
        sides = _sides(figure().triangles)
        directed = set(map(tuple, sides.tolist()))
        assert len(directed) == len(sides)  # no edge twice in one direction
        assert directed == {(b, a) for a, b in directed}  # each has a triangle on both sides
        assert len(figure().rest) - len(sides) // 2 + len(figure().triangles) == 2  # a sphere [Euler]
        a, b, c = (figure().rest[figure().triangles[:, k]] for k in range(3))
        assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0 == pytest.approx(0.0427, rel=0.01)  # [m^3]

    def test_it_lies_where_the_distance_is_0(self) -> None:
        assert np.abs(distance(figure().rest)).max() < 1e-7
        low, high = np.array(character.LOW), np.array(character.HIGH)
        assert (figure().rest > low + character.SPACING).all()
        assert (figure().rest < high - character.SPACING).all()

    def test_its_triangles_are_even(self) -> None:
        a, b, c = (figure().rest[figure().triangles[:, k]] for k in range(3))
        sides = np.stack([np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=1)
        assert sides.max() < 2.1 * character.SPACING
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        quality = 4.0 * np.sqrt(3.0) * area / (sides**2).sum(axis=1)  # 1 where equilateral
        assert quality.min() > 0.15
        assert np.percentile(quality, 5) > 0.5

    def test_finer_cells_give_more_triangles(self) -> None:
        coarse = figure(0.06)
        assert 3.0 < len(figure().triangles) / len(coarse.triangles) < 5.0


class TestBones:
    def test_at_rest_nothing_moves(self) -> None:
        assert np.abs(figure().moved(bones(STILL)) - figure().rest).max() < 1e-15
        assert np.array_equal(bones(0.0), bones(STILL))
        assert np.array_equal(bones(8.0, swing=0.0), bones(0.0))

    def test_weights_add_up(self) -> None:
        weights = figure().weights
        assert weights.shape == (len(figure().rest), len(BONES))
        assert np.allclose(weights.sum(axis=1), 1.0, atol=1e-15)
        elbow = np.argmin(np.linalg.norm(figure().rest - [0.0, 0.29, 0.28], axis=1))
        assert weights[elbow, BONES.index("left arm")] > 0.999

    def test_a_bone_moves_its_skin_as_a_rigid_body(self) -> None:
        head = figure().weights[:, BONES.index("head")] > 1.0 - 1e-5
        assert head.sum() > 50
        moved = figure().moved(bones(8.3))[head]
        at = figure().rest[head]
        assert np.linalg.norm(moved - at, axis=1).max() > 0.01
        between, before = (np.linalg.norm(p[1:] - p[:-1], axis=1) for p in (moved, at))
        assert np.allclose(between, before, atol=1e-5)

    def test_the_motion_is_smooth_and_moves_the_shoulders(self) -> None:
        step = 0.01
        times = np.arange(STILL - 0.1, 10.0, step)
        path = np.stack([figure().moved(bones(time)) for time in times])
        speed = np.linalg.norm(np.diff(path, axis=0), axis=2) / step
        acceleration = np.linalg.norm(np.diff(path, n=2, axis=0), axis=2) / step**2
        assert 0.2 < speed.max() < 1.0  # [m/s]
        assert acceleration.max() < 5.0  # [m/s^2]
        assert acceleration[: int((0.1 + 0.05 * EASE) / step)].max() < 0.3  # it starts gently
