"""Frames that do not end."""

import subprocess
import sys
import time

_HANGS = """
import time
from types import SimpleNamespace as Some
from stickslip_blender.cycles import pixels

seconds = iter([0.2, 0.2, 100.0])
operators = Some(render=Some(render=lambda write_still: time.sleep(next(seconds))))
pixels.import_bpy = lambda: Some(ops=operators)
pixels.LEAST_SECONDS = 0.5
render = Some(image_settings=Some(), resolution_x=4, resolution_y=4)
reader = pixels.FrameReader(Some(render=render, cycles=Some(samples=1)))
for frame in range(3):
    print("frame", frame, flush=True)
    reader._rendered("RGB", None)
"""


def test_a_process_whose_frame_hangs_is_ended_after_a_time_that_follows_from_its_frames() -> None:
    """Frames of 0.2 s may take 20 times as long, and half a second."""
    start = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", _HANGS], capture_output=True, text=True, check=False, timeout=60
    )
    assert time.monotonic() - start > 4.5
    assert done.returncode == 1
    assert done.stdout.split() == ["frame", "0", "frame", "1", "frame", "2"]
    assert "Timeout (" in done.stderr
    assert "_rendered" in done.stderr
