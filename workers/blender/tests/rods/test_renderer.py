"""Rods: the same bytes always, on the dark ground, where the cameras project them."""

import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from stickslip_blender.cycles.pixels import Window
from stickslip_blender.scenes.rod_hang import GROUND_LEVEL, RADIUS, RodRenderer
from stickslip_schemas.spec.cameras import Camera
from stickslip_schemas.spec.jobs import Quality

ORANGE = (0.9, 0.5, 0.2)
Views = npt.NDArray[np.uint8]


@pytest.fixture
def views(curl: npt.NDArray[np.float64], rig: tuple[Camera, ...]) -> Views:
    renderer = RodRenderer(quality=Quality.draft)
    return renderer.render(curl, rig, color=ORANGE)


def test_views_are_pictures(views: Views) -> None:
    assert views.shape == (4, 224, 224, 3)
    assert views.dtype == np.uint8


def test_a_repeat_has_the_same_bytes(
    curl: npt.NDArray[np.float64], rig: tuple[Camera, ...], views: Views
) -> None:
    renderer = RodRenderer(quality=Quality.draft)
    renderer.render(
        curl * (1, -1, 1), rig[::-1], color=(0.1, 0.2, 0.9), radius=0.02
    )  # leaves no trace
    again = renderer.render(curl, rig, color=ORANGE)
    assert np.array_equal(again, views)


_FRESH = """
import hashlib, sys
import numpy as np
from stickslip_blender.scenes.rod_hang import RodRenderer
from stickslip_schemas.spec.cameras import load_rig
from stickslip_schemas.spec.jobs import Quality
renderer = RodRenderer(quality=Quality.draft)
views = renderer.render(np.load(sys.argv[1]), load_rig("rod-4"), color=(0.9, 0.5, 0.2))
print(hashlib.sha256(views.tobytes()).hexdigest())
"""


def test_a_fresh_process_makes_the_same_bytes(
    curl: npt.NDArray[np.float64], views: Views, tmp_path: Path
) -> None:
    np.save(tmp_path / "curl.npy", curl)
    done = subprocess.run(
        [sys.executable, "-c", _FRESH, str(tmp_path / "curl.npy")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == [
        hashlib.sha256(views.tobytes()).hexdigest()
    ]  # and Blender logs nothing there


def test_the_ground_is_dark_even_and_what_blender_would_render(
    curl: npt.NDArray[np.float64],
    rig: tuple[Camera, ...],
    monkeypatch: pytest.MonkeyPatch,
    views: Views,
) -> None:
    assert GROUND_LEVEL < 16
    assert np.median(views) == GROUND_LEVEL
    whole = Window(0, 0, 224, 224)
    monkeypatch.setattr(
        "stickslip_blender.scenes.rod_hang.window_about", lambda vertices, camera: whole
    )
    renderer = RodRenderer(quality=Quality.draft)
    full = renderer.render(curl, rig, color=ORANGE)
    assert np.array_equal(full, views)


def test_the_silhouette_is_the_projected_rod(
    curl: npt.NDArray[np.float64], rig: tuple[Camera, ...], views: Views
) -> None:
    fine = np.stack(
        [np.interp(np.linspace(0, 149, 600), np.arange(150), curl[:, i]) for i in range(3)], axis=1
    )
    for camera, view in zip(rig, views, strict=True):
        pixels, depth = camera.project(fine)
        left, right = int(pixels[:, 0].min()) - 4, int(pixels[:, 0].max()) + 5
        rows, columns = np.mgrid[:224, left:right]
        gap = np.hypot(columns[..., None] - pixels[:, 0], rows[..., None] - pixels[:, 1])
        to_edge = (gap - camera.fx * RADIUS / depth).min(axis=2)  # [px], negative inside
        rod = view.max(axis=2) > GROUND_LEVEL + 2
        assert not rod[:, :left].any()
        assert not rod[:, right:].any()
        rod = rod[:, left:right]
        assert to_edge[rod].max() < 0.75  # a pixel reaches at most 0.71 px from its middle
        assert rod[to_edge < -0.5].all()
        touched = to_edge < 0.45  # coverage is exact: what is touched by a hundredth is seen
        assert (rod & touched).sum() / (rod | touched).sum() > 0.9


def test_the_rod_has_its_color_and_is_not_burnt_out(views: Views) -> None:
    rod = views[views.max(axis=3) > 100].astype(float)
    red, green, blue = np.median(rod, axis=0)
    assert red > green > blue
    assert (rod.min(axis=1) >= 250).mean() < 0.01
    for view in views:
        assert view.max() > 150  # lit in every view


def test_a_thicker_rod_covers_more(
    curl: npt.NDArray[np.float64], rig: tuple[Camera, ...], views: Views
) -> None:
    renderer = RodRenderer(quality=Quality.draft)
    thick = renderer.render(curl, rig, color=ORANGE, radius=2 * RADIUS)
    assert 1.5 < (thick > GROUND_LEVEL + 2).sum() / (views > GROUND_LEVEL + 2).sum() < 2.1


def test_a_rod_that_no_camera_sees_leaves_the_ground(
    curl: npt.NDArray[np.float64], rig: tuple[Camera, ...]
) -> None:
    renderer = RodRenderer(quality=Quality.draft)
    nothing = renderer.render(curl + np.array([0.0, 0.0, 1.5]), rig[:1], color=ORANGE)
    assert (nothing == GROUND_LEVEL).all()


def test_what_is_not_a_rod_is_refused(
    curl: npt.NDArray[np.float64], rig: tuple[Camera, ...]
) -> None:
    renderer = RodRenderer(quality=Quality.draft)
    with pytest.raises(
        ValueError, match=r"centerline must be finite, of shape \(150, 3\); got shape \(149, 3\)"
    ):
        renderer.render(curl[1:], rig, color=ORANGE)
    with pytest.raises(ValueError, match="centerline must be finite"):
        renderer.render(curl * np.nan, rig, color=ORANGE)
    with pytest.raises(ValueError, match=r"radius must be in \(0, 0.1\) L; got 0.2"):
        renderer.render(curl, rig, color=ORANGE, radius=0.2)


def test_a_second_renderer_ends_the_first(
    curl: npt.NDArray[np.float64], rig: tuple[Camera, ...]
) -> None:
    first, second = RodRenderer(quality=Quality.draft), RodRenderer(quality=Quality.draft)
    with pytest.raises(ReferenceError):
        first.render(curl, rig, color=ORANGE)
    del second


def test_an_idle_renderer_takes_no_processor_time() -> None:
    """Blender's idle worker threads would spin.

    A process that waits for its next task must leave the core alone.
    """
    script = """
import time
import numpy as np
from stickslip_blender.scenes.rod_hang import RodRenderer, silicone_color
from stickslip_schemas.spec.cameras import load_rig
line = np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), 150)
renderer = RodRenderer(quality="draft")
renderer.render(line, load_rig("rod-4"), color=silicone_color(0))
before = time.process_time()
time.sleep(1.0)
print(time.process_time() - before)
"""
    answer = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    ).stdout.split()
    assert float(answer[-1]) < 0.05
