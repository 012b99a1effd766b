"""Animated meshes of other programs: what Blender writes is read back, in a process of its own."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

_WRITE = """
import sys
from stickslip_blender.cycles.blender import import_bpy
bpy = import_bpy()
bpy.ops.wm.read_factory_settings(use_empty=True)
mesh = bpy.data.meshes.new("wedge")
mesh.from_pydata([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 0.5, 1)], [],
                 [(3, 2, 1, 0), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)])
thing = bpy.data.objects.new("wedge", mesh)
scene = bpy.context.scene
scene.collection.objects.link(thing)
scene.render.fps, scene.frame_start, scene.frame_end = 25, 1, 6
for frame in range(1, 7):
    thing.location = (0.1 * frame, 0.0, 0.02 * frame * frame)
    thing.keyframe_insert("location", frame=frame)
kind = sys.argv[1].rpartition(".")[2]
if kind == "abc":
    bpy.ops.wm.alembic_export(filepath=sys.argv[1], start=1, end=6, as_background_job=False)
elif kind == "obj":
    bpy.ops.wm.obj_export(filepath=sys.argv[1], forward_axis="Y", up_axis="Z", export_materials=False)
else:
    bpy.ops.wm.usd_export(filepath=sys.argv[1], export_animation=True)
"""


def _run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("suffix", ["abc", "usdc"])
def test_an_animated_file_is_read_frame_by_frame(suffix: str, tmp_path: Path) -> None:
    file, out = tmp_path / f"wedge.{suffix}", tmp_path / "wedge.npz"
    written = _run("-c", _WRITE, str(file))
    assert file.is_file(), written.stderr
    ended = _run("-m", "stickslip_blender.import_mesh", str(file), str(out), "--scale", "0.5", "--frame-rate", "25")
    assert ended.returncode == 0, ended.stderr
    with np.load(out) as found:
        positions, triangles, times = found["positions"], found["triangles"], found["times"]
    assert positions.shape == (6, 5, 3)
    assert triangles.shape == (6, 3)
    assert times == pytest.approx(np.arange(6) / 25)
    frames = np.arange(1, 7)
    tip = positions[:, np.argmax(positions[0, :, 2])]
    assert tip == pytest.approx(
        0.5 * np.stack([0.5 + 0.1 * frames, 0.5 + 0 * frames, 1 + 0.02 * frames**2], 1), abs=1e-6
    )
    a, b, c = (positions[-1][triangles[:, k]] - positions[-1].mean(axis=0) for k in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0 == pytest.approx(0.5**3 / 3.0)  # closed, and faces outward


def test_a_still_file_has_one_frame(tmp_path: Path) -> None:
    file, out = tmp_path / "wedge.obj", tmp_path / "wedge.npz"
    assert _run("-c", _WRITE, str(file)).returncode == 0
    assert _run("-m", "stickslip_blender.import_mesh", str(file), str(out)).returncode == 0
    with np.load(out) as found:
        assert found["positions"].shape == (1, 5, 3)
        assert found["positions"][0, :, 2].max() == pytest.approx(1.72, abs=1e-5)  # z stays up


def test_what_holds_no_such_mesh_is_refused(tmp_path: Path) -> None:
    file, out = tmp_path / "wedge.usdc", tmp_path / "wedge.npz"
    assert _run("-c", _WRITE, str(file)).returncode == 0
    for arguments, message in (
        ([str(file), "--object", "sphere"], "must hold a mesh named sphere, and its meshes are: wedge"),
        ([str(tmp_path / "wedge.xyz")], "must end in one of .abc, .usd"),
        ([str(tmp_path / "other.abc")], "no such file"),
    ):
        ended = _run("-m", "stickslip_blender.import_mesh", arguments[0], str(out), *arguments[1:])
        assert ended.returncode == 1
        assert message in ended.stderr
    assert not out.exists()
