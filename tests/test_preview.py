"""`stickslip scene preview` draws a scene without simulating it, within seconds."""

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

BLENDER_PYTHON = Path(sys.prefix).parent / ".venv-blender/bin/python"
CPU_SECONDS = 20.0

FOLD = """
format: stickslip-scene/1
duration: 2
frame_rate: 10
default_friction: 0.4
sheets:
  napkin:
    material: gray-interlock
    mesh: {type: grid, size: [0.2, 0.2], cells: [10, 10]}
    origin: [0, 0, 0.001]
    holders:
      hand:
        low: [0.08, 0.08]
        high: [0.1, 0.1]
        grasp: [0.5, 1.5]
        motion: {keys: [{time: 0}, {time: 2, move: [-0.1, -0.1, 0.05]}]}
bodies:
  table: {type: plane}
  block: {type: box, size: [0.05, 0.05, 0.05], origin: [0.2, 0, 0.025]}
looks:
  bodies: {block: {color: [0.6, 0.05, 0.05]}}
  cameras: {above: {position: [0.3, -0.6, 0.9], target: [0.05, 0, 0]}}
"""


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.skipif(not BLENDER_PYTHON.exists(), reason="no environment of Blender: make setup")
@pytest.mark.parametrize("is_custom", [False, True])
def test_a_scene_is_drawn_before_it_is_simulated(tmp_path: Path, is_custom: bool) -> None:
    scene = tmp_path / "fold.yaml"
    scene.write_text(FOLD)
    out = tmp_path / "pictures"
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    name = str(scene) if is_custom else "turning-ball"
    subprocess.run(
        [sys.executable, "-m", "stickslip_services.cli", "scene", "preview", name, str(out)],
        check=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < CPU_SECONDS
    views = ["above"] if is_custom else ["front", "high", "side"]
    assert sorted(path.name for path in out.iterdir()) == sorted(
        [*(f"{view}.png" for view in views), "motion.webp"]
    )
    with Image.open(out / "motion.webp") as clip:
        assert clip.size == (320 * len(views), 320)
        first = np.asarray(clip.convert("RGB"), dtype=float)
        clip.seek(clip.n_frames - 1)  # type: ignore[attr-defined]
        moved = np.abs(np.asarray(clip.convert("RGB")) - first).max(axis=2) > 40
    assert 30 < moved.sum() < 0.2 * moved.size
    with Image.open(out / f"{views[0]}.png") as picture:
        pixels = np.asarray(picture.convert("RGB"), dtype=int)
    if is_custom:
        assert ((pixels[..., 0] > 150) & (pixels[..., 1] < 100)).sum() > 200  # the block is red
