"""Motions that a user prescribes: keyframes and animated meshes."""

import numpy as np
import pytest

from stickslip_sim_core.scenes.motions import Keyframes, MovingMesh, Spin, rotation


class TestRotation:
    def test_it_turns_about_its_vector(self) -> None:
        assert rotation([0.0, 0.0, np.pi / 2]) @ [1.0, 0.0, 0.0] == pytest.approx([0.0, 1.0, 0.0])
        assert rotation([0.0, 0.0, 0.0]) == pytest.approx(np.eye(3))
        turn = rotation([0.3, -0.8, 0.5])
        assert turn @ turn.T == pytest.approx(np.eye(3))
        assert np.linalg.det(turn) == pytest.approx(1.0)
        assert turn @ [0.3, -0.8, 0.5] == pytest.approx([0.3, -0.8, 0.5])

    def test_right_angles_are_exact(self) -> None:
        third = 2.0 * np.pi / 3.0 / np.sqrt(3.0)
        assert rotation([third, third, third]).tolist() == [[0, 0, 1], [1, 0, 0], [0, 1, 0]]


class TestKeyframes:
    def test_keys_are_met_without_overshoot(self) -> None:
        keys = Keyframes(
            [0.0, 1.0, 2.0, 4.0], [[0, 0, 0], [1, 0, 0], [1, 2, 0], [3, 1, 0]], np.zeros((4, 3))
        )
        for time, move in zip(
            (0.0, 1.0, 2.0, 4.0, 9.0),
            ([0, 0, 0], [1, 0, 0], [1, 2, 0], [3, 1, 0], [3, 1, 0]),
            strict=True,
        ):
            assert keys.pose(time)[:, 3] == pytest.approx(move)
        times = np.linspace(0.0, 4.0, 401)
        path = np.stack([keys.pose(time)[:, 3] for time in times])
        assert path[:, 0].max() <= 3.0
        assert np.allclose(path[100:201, 0], 1.0)  # it stays where two keys say the same
        assert path[:, 1].max() <= 2.0
        speed = np.diff(path, axis=0) / 0.01
        assert np.abs(np.diff(speed, axis=0)).max() < 0.2  # no jump
        assert np.abs(speed[[0, -1]]).max() < 0.05  # at rest at both ends

    def test_turns_are_about_a_point(self) -> None:
        keys = Keyframes(
            [0.0, 1.0],
            np.zeros((2, 3)),
            np.array([[0, 0, 0], [0, 0, np.pi]]),
            about=[1.0, 0.0, 0.0],
        )
        turn, move = keys.pose(1.0)[:, :3], keys.pose(1.0)[:, 3]
        assert turn @ [1.0, 0.0, 0.0] + move == pytest.approx([1.0, 0.0, 0.0])
        assert turn @ [2.0, 0.0, 0.0] + move == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)

    @pytest.mark.parametrize(
        ("times", "moves", "message"),
        [
            ([1.0, 1.0], np.zeros((2, 3)), "times: must be one or more instants that ascend"),
            ([-1.0], np.zeros((1, 3)), "times: must be one or more instants that ascend from 0 s"),
            ([0.0, 1.0], np.zeros((3, 3)), r"moves: must be finite, of shape \(2, 3\)"),
        ],
    )
    def test_refusals(self, times: list[float], moves: np.ndarray, message: str) -> None:
        with pytest.raises(ValueError, match=message):
            Keyframes(times, moves, np.zeros((len(times), 3)))


class TestMovingMesh:
    def test_frames_are_met_and_parabolas_are_exact_between(self) -> None:
        times = np.array([0.0, 0.5, 0.7, 1.5, 2.0])
        mesh = MovingMesh(
            np.array([[0, 1, 2]]), times, times[:, None, None] ** 2 * np.ones((5, 3, 3))
        )
        for time in times:
            assert mesh.at(time) == pytest.approx(np.full((3, 3), time**2))
        assert mesh.at(1.1) == pytest.approx(np.full((3, 3), 1.1**2))
        assert mesh.at(3.0) == pytest.approx(np.full((3, 3), 4.0))


class TestOtherMotions:
    def test_a_linear_motion_has_even_speeds_and_ramps(self) -> None:
        keys = Keyframes(
            [0.0, 3.0], [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], np.zeros((2, 3)), linear=True, ramp=1.0
        )
        at = [keys.pose(time)[0, 3] for time in (0.0, 0.5, 1.0, 2.0, 3.0, 3.5, 4.0, 9.0)]
        assert at == pytest.approx([0.0, 0.125, 0.5, 1.5, 2.5, 2.875, 3.0, 3.0])
        assert keys.last == 4.0
        sharp = Keyframes(
            [0.0, 3.0], [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], np.zeros((2, 3)), linear=True
        )
        assert sharp.pose(1.5)[0, 3] == pytest.approx(1.5)

    def test_a_spin_gains_its_speed_and_keeps_it(self) -> None:
        spin = Spin([0, 0, 2.0], speed=0.5, begin=1.0, ramp=2.0, about=[1.0, 0.0, 0.0])
        for time, angle in ((0.5, 0.0), (2.0, 0.125), (3.0, 0.5), (4.0, 1.0)):
            pose = spin.pose(time)
            assert pose[:, :3] == pytest.approx(rotation([0.0, 0.0, angle]))
            assert pose[:, :3] @ [1.0, 0.0, 0.0] + pose[:, 3] == pytest.approx([1.0, 0.0, 0.0])

    def test_a_skin_follows_its_bones_and_its_strength(self) -> None:
        bones = np.tile(np.eye(3, 4), (2, 2, 1, 1))
        bones[1, 1, 2, 3] = 1.0
        weights = np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]])
        for strength in (1.0, 0.5):
            mesh = MovingMesh(
                np.array([[0, 1, 2]]), [0.0, 1.0], bones, np.eye(3), weights, strength
            )
            moved = mesh.at(1.0) - np.eye(3)
            assert moved[:, 2] == pytest.approx(strength * np.array([0.0, 0.5, 1.0]))
