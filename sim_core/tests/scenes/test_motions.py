"""Motions that a user prescribes: keyframes and animated meshes."""

from pathlib import Path

import numpy as np
import pytest

from stickslip_sim_core.scenes.motions import (
    Keyframes,
    MovingMesh,
    Spin,
    read_moving_mesh,
    read_obj,
    read_path,
    read_pattern,
    rotation,
)

SQUARE = """# a square of two triangles, and a corner that is named from the end
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0.5
vt 0 0
vn 0 0 1
f 1/1/1 2/1/1 3/1/1 -1//1
"""


class TestRotation:
    def test_it_turns_about_its_vector(self) -> None:
        assert rotation([0.0, 0.0, np.pi / 2]) @ [1.0, 0.0, 0.0] == pytest.approx([0.0, 1.0, 0.0])
        assert rotation([0.0, 0.0, 0.0]) == pytest.approx(np.eye(3))
        turn = rotation([0.3, -0.8, 0.5])
        assert turn @ turn.T == pytest.approx(np.eye(3))
        assert np.linalg.det(turn) == pytest.approx(1.0)
        assert turn @ [0.3, -0.8, 0.5] == pytest.approx([0.3, -0.8, 0.5])


class TestKeyframes:
    def test_keys_are_met_without_overshoot(self) -> None:
        keys = Keyframes([0.0, 1.0, 2.0, 4.0], [[0, 0, 0], [1, 0, 0], [1, 2, 0], [3, 1, 0]], np.zeros((4, 3)))
        for time, move in zip(
            (0.0, 1.0, 2.0, 4.0, 9.0), ([0, 0, 0], [1, 0, 0], [1, 2, 0], [3, 1, 0], [3, 1, 0]), strict=True
        ):
            assert keys.at(time)[1] == pytest.approx(move)
        times = np.linspace(0.0, 4.0, 401)
        path = np.stack([keys.at(time)[1] for time in times])
        assert path[:, 0].max() <= 3.0
        assert np.allclose(path[100:201, 0], 1.0)  # it stays where two keys say the same
        assert path[:, 1].max() <= 2.0
        speed = np.diff(path, axis=0) / 0.01
        assert np.abs(np.diff(speed, axis=0)).max() < 0.2  # no jump
        assert np.abs(speed[[0, -1]]).max() < 0.05  # at rest at both ends

    def test_turns_are_about_a_point(self) -> None:
        keys = Keyframes([0.0, 1.0], np.zeros((2, 3)), np.array([[0, 0, 0], [0, 0, np.pi]]), about=[1.0, 0.0, 0.0])
        turn, move = keys.at(1.0)
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
        mesh = MovingMesh(np.array([[0, 1, 2]]), times, times[:, None, None] ** 2 * np.ones((5, 3, 3)))
        for time in times:
            assert mesh.at(time) == pytest.approx(np.full((3, 3), time**2))
        assert mesh.at(1.1) == pytest.approx(np.full((3, 3), 1.1**2))
        assert mesh.at(3.0) == pytest.approx(np.full((3, 3), 4.0))

    def test_an_obj_file(self, tmp_path: Path) -> None:
        file = tmp_path / "square.obj"
        file.write_text(SQUARE)
        vertices, triangles = read_obj(file)
        assert vertices.shape == (4, 3)
        assert vertices[3].tolist() == [0.0, 1.0, 0.5]
        assert triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
        assert read_moving_mesh(file).at(5.0) == pytest.approx(vertices)

    def test_a_folder_and_an_npz_file(self, tmp_path: Path) -> None:
        folder = tmp_path / "frames"
        folder.mkdir()
        for frame in range(3):
            (folder / f"{frame:04d}.obj").write_text(SQUARE.replace("0.5", f"{0.5 + frame}"))
        mesh = read_moving_mesh(folder, frame_rate=10.0)
        assert np.asarray(mesh.times) == pytest.approx([0.0, 0.1, 0.2])
        assert mesh.at(0.1)[3, 2] == pytest.approx(1.5)
        np.savez(tmp_path / "m.npz", positions=mesh.frames, triangles=mesh.triangles, times=mesh.times)
        assert read_moving_mesh(tmp_path / "m.npz").at(0.13) == pytest.approx(mesh.at(0.13))

    def test_refusals(self, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        with pytest.raises(ValueError, match="must hold OBJ files, one a frame"):
            read_moving_mesh(tmp_path / "empty")
        (tmp_path / "a.obj").write_text("v 0 0\n")
        with pytest.raises(ValueError, match=r"a.obj, line 1: must be a vertex or a face, got 'v 0 0'"):
            read_moving_mesh(tmp_path / "a.obj")
        (tmp_path / "b.obj").write_text("v 0 0 0\nv 1 0 0\nf 1 2 3\n")
        with pytest.raises(ValueError, match="line 3: must be a vertex or a face"):
            read_moving_mesh(tmp_path / "b.obj")
        (tmp_path / "c.obj").write_text("v 0 0 0\n")
        with pytest.raises(ValueError, match="must have faces, and has none"):
            read_moving_mesh(tmp_path / "c.obj")
        with pytest.raises(ValueError, match="must be an OBJ file, a folder of OBJ files, or an NPZ file"):
            read_moving_mesh(tmp_path / "d.abc")
        np.savez(tmp_path / "e.npz", positions=np.zeros((1, 3, 3)))
        with pytest.raises(ValueError, match="triangles, times is not there"):
            read_moving_mesh(tmp_path / "e.npz")
        frames = tmp_path / "frames"
        frames.mkdir()
        (frames / "0.obj").write_text(SQUARE)
        with pytest.raises(ValueError, match="frame_rate: must be > 0 for a folder of frames, got None"):
            read_moving_mesh(frames)
        (frames / "1.obj").write_text(SQUARE + "v 0 0 0\n")
        with pytest.raises(ValueError, match=r"1.obj: must have the vertices and faces of 0.obj"):
            read_moving_mesh(frames, frame_rate=1.0)


class TestOtherMotions:
    def test_a_linear_motion_has_even_speeds_and_ramps(self) -> None:
        keys = Keyframes([0.0, 3.0], [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], np.zeros((2, 3)), linear=True, ramp=1.0)
        at = [keys.pose(time)[0, 3] for time in (0.0, 0.5, 1.0, 2.0, 3.0, 3.5, 4.0, 9.0)]
        assert at == pytest.approx([0.0, 0.125, 0.5, 1.5, 2.5, 2.875, 3.0, 3.0])
        assert keys.last == 4.0
        sharp = Keyframes([0.0, 3.0], [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], np.zeros((2, 3)), linear=True)
        assert sharp.pose(1.5)[0, 3] == pytest.approx(1.5)

    def test_a_spin_gains_its_speed_and_keeps_it(self) -> None:
        spin = Spin([0, 0, 2.0], speed=0.5, begin=1.0, ramp=2.0, about=[1.0, 0.0, 0.0])
        for time, angle in ((0.5, 0.0), (2.0, 0.125), (3.0, 0.5), (4.0, 1.0)):
            pose = spin.pose(time)
            assert pose[:, :3] == pytest.approx(rotation([0.0, 0.0, angle]))
            assert pose[:, :3] @ [1.0, 0.0, 0.0] + pose[:, 3] == pytest.approx([1.0, 0.0, 0.0])

    def test_a_path_is_read_from_csv_and_npz(self, tmp_path: Path) -> None:
        (tmp_path / "p.csv").write_text("time,x,y,z,rx,ry,rz\n0,0,0,0,0,0,0\n1.5,1,2,3,0,0,0.5\n")
        times, moves, turns = read_path(tmp_path / "p.csv")
        np.savez(tmp_path / "p.npz", time=times, move=moves, turn=turns)
        for again, first in zip(read_path(tmp_path / "p.npz"), (times, moves, turns), strict=True):
            assert np.array_equal(again, first)
        assert (times[-1], moves[-1].tolist(), turns[-1].tolist()) == (1.5, [1.0, 2.0, 3.0], [0.0, 0.0, 0.5])
        (tmp_path / "q.csv").write_text("t,x\n0,0\n")
        with pytest.raises(ValueError, match="must have the columns time,x,y,z,rx,ry,rz, got 't,x'"):
            read_path(tmp_path / "q.csv")

    def test_a_skin_follows_its_bones_and_its_strength(self, tmp_path: Path) -> None:
        bones = np.tile(np.eye(3, 4), (2, 2, 1, 1))
        bones[1, 1, 2, 3] = 1.0
        skin = {"rest": np.eye(3), "weights": np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]]), "bones": bones}
        np.savez(tmp_path / "s.npz", triangles=[[0, 1, 2]], times=[0.0, 1.0], **skin)  # type: ignore[arg-type]
        for strength in (1.0, 0.5):
            moved = read_moving_mesh(tmp_path / "s.npz", strength=strength).at(1.0) - np.eye(3)
            assert moved[:, 2] == pytest.approx(strength * np.array([0.0, 0.5, 1.0]))

    def test_a_pattern_is_the_texture_coordinates(self, tmp_path: Path) -> None:
        text = "v 0 0 1\nv 1 0 1\nv 0 1 2\nvt 0 0\nvt 1 0\nvt 0 1.2\n"
        (tmp_path / "p.obj").write_text(text + "f 1/1 2/2 3/3\n")
        mesh, start = read_pattern(tmp_path / "p.obj")
        assert mesh.rest.tolist() == [[0.0, 0.0], [1.0, 0.0], [0.0, 1.2]]
        assert start[2].tolist() == [0.0, 1.0, 2.0]
        for face, message in (("f 1 2 3", "flat pattern, at each corner"), ("f 1/1 2/2 3/3\nf 1/2 2/2 3/3", "several")):
            (tmp_path / "q.obj").write_text(text + face + "\n")
            with pytest.raises(ValueError, match=message):
                read_pattern(tmp_path / "q.obj")
