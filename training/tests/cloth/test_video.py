"""Videos of one's own: a film of rendered cloth, with a lens, a hand that shakes and a codec that
loses.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from stickslip_schemas.spec.cameras import load_rig
from stickslip_testing.films import meshes_at, write_film
from stickslip_training.cloth import video
from stickslip_training.cloth.clips import INSTANTS, RATE
from stickslip_training.cloth.crop import ANCHOR, Cameras, Crops, cut, holder_crops
from stickslip_training.cloth.render import refine, splat
from stickslip_training.cloth.video import (
    FLOOR_MAX,
    VideoError,
    floor_motion,
    import_video,
    load_camera,
)

pytest.importorskip("av")
cv2 = pytest.importorskip("cv2")

START, FRAMES_A_SECOND, DISTORTION = 1.7, 9, (-0.12, 0.05, 0.001, -0.0005, 0.0)
CAMERA = next(camera for camera in load_rig("drag") if camera.name == "calibrated")
LENS = CAMERA.model_copy(update={"distortion": DISTORTION})

pytestmark = pytest.mark.physics  # films are written and tracked


def marks(contrast):
    """Return a floor, (224, 224): dark, with marks as faint as grain of wood."""
    fine = np.random.default_rng(0).normal(0.0, 1.0, (224, 224)).astype(np.float32)
    return torch.from_numpy(0.05 + contrast * cv2.GaussianBlur(fine, (0, 0), 1.5) * 5)


def pictures(run, seconds, floor=0.05):
    """Return grey levels (F, 224, 224) as a pinhole camera sees them: a checked cloth on a dark
    floor.
    """
    lines = torch.linspace(0, 1, 112)
    checks = 0.35 + 0.3 * ((lines[:, None] * 20).floor() + (lines * 20).floor()).remainder(2)
    frames = []
    for mesh in torch.from_numpy(meshes_at(run, seconds)).split(32):
        fine = refine(mesh[None], 112)
        whole = Crops(torch.tensor(ANCHOR[::-1]).expand(1, len(mesh), 2), torch.ones(1, len(mesh)))
        colors = checks.expand(fine.shape[:-1])
        alpha, color = splat(fine, colors, Cameras.of([CAMERA]), whole, size=(224, 224))
        frames.append((alpha * color + (1 - alpha) * floor)[0])
    return torch.cat(frames).numpy()


def filmed(path, frames, shake):
    """Write a film of grey pictures (F, 224, 224), 0 to 1."""
    colored = (np.repeat(255 * frame[..., None], 3, axis=2) for frame in frames)
    write_film(path, colored, CAMERA, rate=FRAMES_A_SECOND, distortion=DISTORTION, shake=shake)


@pytest.fixture(scope="module")
def run(runs):
    return runs[np.flatnonzero(runs.mu > 0.4)[:1]]


@pytest.fixture(scope="module")
def scene_of_film(run):
    """93 s after the start, nine pictures a second, and when each is taken."""
    seconds = np.arange(0.0, START + INSTANTS[-1] / RATE + 1.0, 1 / FRAMES_A_SECOND) - START
    return seconds, pictures(run, seconds, marks(0.01))


@pytest.fixture(scope="module")
def film(scene_of_film, tmp_path_factory):
    """All pictures, with 1 px of shake."""
    path = tmp_path_factory.mktemp("film") / "film.mp4"
    shake = np.random.default_rng(1).normal(0.0, 0.05, (len(scene_of_film[0]), 2)).cumsum(axis=0)
    shake -= shake[0]
    filmed(path, scene_of_film[1], shake)
    return path


@pytest.fixture(scope="module")
def imported(film):
    return import_video(film, LENS)


def wanted_crops(run, floor=0.05):
    direct = torch.from_numpy(pictures(run, np.array(INSTANTS) / RATE, floor))[None]
    return cut(direct, holder_crops(Cameras.of([CAMERA]), INSTANTS))


def test_start_shake_and_crops_are_found(imported, run):
    clip, recognized = imported
    assert recognized.start == pytest.approx(START, abs=0.03)
    assert recognized.residual < 0.3
    blind = (clip.crops - wanted_crops(run, marks(0.01))).abs().mean()
    assert blind < 0.02  # lens and codec; contrast is 0.3 to 0.6
    assert clip.direction[0].tolist() == pytest.approx(CAMERA.rotation[2])


def test_a_film_that_begins_half_a_second_late_over_a_floor_without_marks_gives_the_same_crops(
    run, scene_of_film, tmp_path
):
    seconds = scene_of_film[0][20:]
    assert 0.5 < seconds[0] < 0.6
    filmed(tmp_path / "late.mp4", pictures(run, seconds), np.zeros((len(seconds), 2)))
    clip, recognized = import_video(tmp_path / "late.mp4", LENS)
    assert recognized.start == pytest.approx(-seconds[0], abs=0.05)
    assert (clip.crops - wanted_crops(run)).abs().mean() < 0.01


def test_the_floor_tells_how_the_camera_moved(run):
    """Its marks, as faint as noise, outweigh the marks of cloth that moves."""
    seconds = np.array(INSTANTS[::5]) / RATE
    moved = np.array([23.3, -11.6])
    for contrast in (0.01, 0.1):
        first, last = (255 * pictures(run, seconds, marks(contrast))).round().astype(np.uint8)
        shifted = cv2.warpAffine(
            last, np.array([[1.0, 0.0, moved[0]], [0.0, 1.0, moved[1]]]), (224, 224)
        )
        motion, deviation = floor_motion(first, shifted, moved + np.array([1.5, -1.0]))
        assert motion == pytest.approx(moved, abs=0.1)
        assert deviation < 0.05
    blank, noise = (
        np.full((224, 224), 200, np.uint8),
        np.random.default_rng(1).normal(0, 1, (2, 224, 224)),
    )
    assert floor_motion(blank, blank, np.zeros(2))[1] == math.inf
    assert floor_motion(*(blank + noise).round().astype(np.uint8), np.zeros(2))[1] > FLOOR_MAX


def test_a_wrong_frame_rate_is_refused(film):
    for rate, message in (
        (1.1 * FRAMES_A_SECOND, "must"),
        (2.0, "frame_rate must be at least 8.3 frames a second"),
    ):
        with pytest.raises(VideoError, match=message):
            import_video(film, LENS, frame_rate=rate)
    with pytest.raises(
        VideoError, match="frame_rate must be more than 0 frames a second and finite, and is -1"
    ):
        import_video(film, LENS, frame_rate=-1.0)


def test_a_wrong_start_is_refused(film):
    with pytest.raises(
        VideoError, match=r"the start must be the same in both halves .* and differs by"
    ):
        import_video(film, LENS, start=START - 1.0)


def test_another_camera_is_refused(film):
    with pytest.raises(
        VideoError,
        match="frames must have the size of the calibration, 300 x 224, and have 224 x 224",
    ):
        import_video(film, LENS.model_copy(update={"width": 300}))


def test_a_short_video_is_refused(run, tmp_path):
    filmed(tmp_path / "short.mp4", pictures(run, np.arange(30) / 6.0), np.zeros((30, 2)))
    with pytest.raises(
        VideoError, match=r"the video must show 91 s from the start on, and lasts 3\.2 s"
    ):
        import_video(tmp_path / "short.mp4", LENS)


def test_what_is_no_video_is_refused(tmp_path):
    (tmp_path / "none.mp4").write_text("nothing")
    with pytest.raises(VideoError, match="must be a video that FFmpeg reads"):
        import_video(tmp_path / "none.mp4", CAMERA)


def test_calibration_is_read_as_opencv_writes_it(tmp_path):
    vector = cv2.Rodrigues(np.array(CAMERA.rotation))[0].ravel().tolist()
    keys = {key: getattr(CAMERA, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    lines = [f"{key} = {value}" for key, value in keys.items()]
    lines += [
        f"rotation = {vector}",
        f"translation = {list(CAMERA.translation)}",
        "distortion = [-0.1, 0.0, 0.0, 0.0]",
    ]
    (tmp_path / "camera.toml").write_text("\n".join(lines))
    read = load_camera(tmp_path / "camera.toml")
    assert np.allclose(read.rotation, CAMERA.rotation, atol=1e-9)
    assert read.distortion == (-0.1, 0.0, 0.0, 0.0, 0.0)
    (tmp_path / "camera.toml").write_text("\n".join([*lines[:-1], "distortion = [1.0]"]))
    with pytest.raises(ValueError, match=r"distortion\.1: Field required"):
        load_camera(tmp_path / "camera.toml")
    (tmp_path / "camera.toml").write_text("\n".join(lines[1:]))
    with pytest.raises(ValueError, match=r"must describe a camera: width: Field required"):
        load_camera(tmp_path / "camera.toml")


def test_reasons_name_rule_and_value(imported):
    wrong = replace(imported[1], residual=2.5, timing=math.nan)
    assert [reason.split(" must")[0] for reason in wrong.refusals()] == ["the holders", "the start"]
    assert "are 2.50 px off" in wrong.refusals()[0]


def test_a_floor_that_moves_apart_from_the_holders_is_refused(scene_of_film, tmp_path, monkeypatch):
    filmed(tmp_path / "film.mp4", scene_of_film[1], np.zeros((len(scene_of_film[0]), 2)))
    registered = video._register

    def astray(*args):  # the patches slipped off the holders in the last third
        registration, wanders = registered(*args)
        wanders[600:] += 2.3
        return registration, wanders

    monkeypatch.setattr(video, "_register", astray)
    with pytest.raises(
        VideoError, match=r"one motion of the camera to within 2 px .*, and differ by 2\.\d"
    ):
        import_video(tmp_path / "film.mp4", LENS)
