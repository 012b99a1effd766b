"""From views to centrelines, on pictures of our own: silhouettes of tubes, counted on a fine grid
of points.
"""

import json
import re

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree
from stickslip_schemas.spec.cameras import Camera, load_rig
from stickslip_training.cli import app
from stickslip_training.reconstruction.photographs import read_calibration, reconstruct_folder
from stickslip_training.reconstruction.pipeline import Verdict, reconstruct
from stickslip_training.reconstruction.views import ReconstructionError
from typer.testing import CliRunner

RIG = load_rig("rod-4")
RADIUS = 0.008
FINE = 5  # points a side of a pixel
COLOR, GROUND = np.array([0.7, 0.35, 0.1]), 0.003  # linear light
runner = CliRunner(env={"COLUMNS": "120", "NO_COLOR": "1"})


def curl(turns, opening, count=150):
    """A hanging curl of length 1, wider towards its free end, at uniform arc length."""
    s = np.linspace(0.0, 1.0, 20 * (count - 1) + 1)
    tilt, turn = opening * np.sin(0.5 * np.pi * s), 2.0 * np.pi * turns * s
    tangent = np.stack(
        [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)], axis=1
    )
    steps = 0.5 * (tangent[1:] + tangent[:-1]) * (s[1] - s[0])
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])[::20]


def coverage(line, camera, radius=RADIUS):
    """The share of each pixel that lies within the tube's outline, to 1/FINE^2."""
    dense = np.stack(
        [np.interp(np.linspace(0, 149, 3000), np.arange(150), axis) for axis in line.T], axis=1
    )
    pixels, depth = camera.project(dense)
    half = radius * camera.fx / depth.mean()
    low = np.maximum(np.floor(pixels.min(axis=0) - half - 1), 0).astype(int)
    high = np.minimum(np.ceil(pixels.max(axis=0) + half + 2), [camera.width, camera.height]).astype(
        int
    )
    width, height = high - low
    offset = (np.arange(FINE) + 0.5) / FINE - 0.5
    x = (low[0] + np.arange(width)[:, None] + offset).ravel()
    y = (low[1] + np.arange(height)[:, None] + offset).ravel()
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    inside = cKDTree(pixels).query(grid, distance_upper_bound=half)[0] <= half
    share = np.zeros((camera.height, camera.width))
    share[low[1] : high[1], low[0] : high[0]] = inside.reshape(height, FINE, width, FINE).mean(
        axis=(1, 3)
    )
    return share


def picture(share, *, color=COLOR, noise=0.0, seed=0, vignette=0.0):
    """sRGB in 8 bit."""
    y, x = np.mgrid[-1 : 1 : share.shape[0] * 1j, -1 : 1 : share.shape[1] * 1j]
    ground = (GROUND + vignette * (1.0 + 0.5 * x - 0.3 * y**2))[..., None]
    light = ground + share[..., None] * (color - ground)
    light = light + noise * np.random.default_rng(seed).standard_normal(light.shape)
    encoded = np.where(
        light <= 0.0031308, 12.92 * light, 1.055 * light.clip(1e-9) ** (1 / 2.4) - 0.055
    )
    return np.rint(255 * encoded.clip(0, 1)).astype(np.uint8)


def mean_error(curve, line):
    return float(np.linalg.norm(curve - line, axis=1).mean())


@pytest.fixture(scope="module")
def tight():
    """A curl that crosses itself in every view."""
    line = curl(3.0, 1.45)
    return line, [coverage(line, camera) for camera in RIG]


@pytest.mark.slow
def test_a_curl_that_crosses_itself_in_views_is_found_to_a_thousandth(tight):
    line, shares = tight
    result = reconstruct([picture(share) for share in shares], RIG)
    assert mean_error(result.centerline, line) < 1e-3
    assert result.verdict == Verdict.good, result.reasons
    assert result.centerline.shape == (150, 3)
    assert result.radius == pytest.approx(RADIUS, rel=0.05)
    steps = np.linalg.norm(np.diff(result.centerline, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=2e-3)
    assert result.residual.shape == (4, 150)
    assert result.residual_rms < 0.2
    assert result.views_seen.min() >= 2
    assert result.views_seen.max() == 4


@pytest.mark.slow
def test_noise_and_an_uneven_ground_cost_little():
    line = curl(1.5, 0.9)
    views = [
        picture(
            coverage(line, camera),
            noise=0.02,
            seed=seed,
            vignette=0.02,
            color=np.array([0.3, 0.6, 0.65]),
        )
        for seed, camera in enumerate(RIG)
    ]
    result = reconstruct(views, RIG, radius=RADIUS)
    assert mean_error(result.centerline, line) < 2e-3
    assert result.radius == pytest.approx(RADIUS)


@pytest.mark.slow
def test_units_clamp_and_large_pictures_of_the_user():
    """The same rod, 200 mm long, with another clamp, in pictures with three times the pixels."""
    line, length, clamp = curl(1.0, 0.8), 200.0, np.array([30.0, -20.0, 500.0])
    cameras = []
    for camera in RIG:
        t = length * np.asarray(camera.translation) - np.asarray(camera.rotation) @ clamp
        user_rig = {
            "width": 3 * 224,
            "height": 3 * 224,
            "fx": 3 * 620,
            "fy": 3 * 620,
            "cx": 335.5,
            "cy": 335.5,
        }
        cameras.append(Camera(**{**camera.model_dump(), **user_rig, "translation": tuple(t)}))
    world = clamp + length * line
    views = [picture(coverage(world, camera, length * RADIUS)) for camera in cameras]
    result = reconstruct(views, cameras, length=length, clamp=clamp, points=100)
    s = np.linspace(0, 1, 150)
    even = np.stack([np.interp(np.linspace(0, 1, 100), s, axis) for axis in world.T], axis=1)
    assert mean_error(result.centerline, even) < 1e-3 * length
    assert result.radius == pytest.approx(length * RADIUS, rel=0.05)
    assert result.deviation.max() < 2e-3 * length


@pytest.mark.slow
def test_views_that_contradict_one_another_are_flagged(tight):
    _, shares = tight
    other = coverage(curl(2.0, 1.0), RIG[1])
    views = [picture(share) for share in (shares[0], other, shares[2], shares[3])]
    result = reconstruct(views, RIG)
    assert result.verdict == Verdict.failed
    assert re.search(
        r"(misfit|unexplained share|unsupported share) 0\.\d+ is above", " ".join(result.reasons)
    )


@pytest.mark.slow
def test_a_wrong_length_is_flagged(tight):
    _, shares = tight
    assert (
        reconstruct([picture(share) for share in shares], RIG, length=0.8).verdict == Verdict.failed
    )


def test_what_is_wrong_is_named():
    dark = [np.zeros((224, 224, 3), np.uint8)] * 4
    with pytest.raises(
        ReconstructionError, match="view front: image must show a rod brighter than its ground"
    ):
        reconstruct(dark, RIG)
    with pytest.raises(
        ReconstructionError,
        match="view front must be 224 x 224 pixels as its camera; got 100 x 224",
    ):
        reconstruct([view[:, :100] for view in dark], RIG)
    with pytest.raises(ValueError, match="one view for each of at least 2 cameras; got 3 for 4"):
        reconstruct(dark[:3], RIG)
    with pytest.raises(ValueError, match=r"length must be positive; got 0"):
        reconstruct(dark, RIG, length=0.0)
    with pytest.raises(
        ValueError, match=r"radius must be 0\.0005 to 0\.05 of the length; got 0\.2 of 1\.0"
    ):
        reconstruct(dark, RIG, radius=0.2)
    with pytest.raises(ValueError, match="clamp must be three finite numbers"):
        reconstruct(dark, RIG, clamp=(0.0, 0.0))


CAMERA = """
[[bench.cameras]]
name = "{name}"
width = {width}
height = 224
fx = 620.0
fy = 620.0
cx = 111.5
cy = 111.5
rotation = {rotation}
translation = {translation}
"""


@pytest.fixture
def bench(tmp_path):
    """A folder of photographs and its calibration."""
    line = curl(1.0, 0.8)
    folder = tmp_path / "photographs"
    folder.mkdir()
    text = '[bench]\nabout = "of a test"\nunit = "L"\n'
    for camera, ending in zip(RIG, ("png", "jpg", "PNG", "png"), strict=True):
        image = Image.fromarray(picture(coverage(line, camera)))
        image.save(
            folder / f"{camera.name}.{ending}", **({"quality": 95} if ending == "jpg" else {})
        )
        rotation, translation = json.loads(
            camera.model_dump_json(include={"rotation", "translation"})
        ).values()
        text += CAMERA.format(
            name=camera.name, width=224, rotation=rotation, translation=translation
        )
    calibration = tmp_path / "calibration.toml"
    calibration.write_text(text)
    return folder, calibration, line


@pytest.mark.physics
def test_the_command_writes_centreline_overlay_and_report(bench, tmp_path):
    folder, calibration, line = bench
    out = tmp_path / "out"
    command = ["reconstruct", str(folder), "--calibration", str(calibration), "--out", str(out)]
    result = runner.invoke(app, command)
    assert result.exit_code == 0, result.output
    assert "good: misfit" in result.output
    table = np.genfromtxt(out / "centerline.csv", delimiter=",", names=True)
    curve = np.stack([table["x"], table["y"], table["z"]], axis=1)
    assert mean_error(curve, line) < 1e-3
    assert table["arc_length"][-1] == 1.0
    with np.load(out / "centerline.npz") as file:
        np.testing.assert_allclose(file["centerline"], curve, atol=1e-8)
    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] == "good"
    assert set(report["residual_rms_px_by_view"]) == {"front", "side", "high", "low"}
    with Image.open(out / "overlay.png") as sheet:
        assert sheet.width == 4 * sheet.height
        assert (np.asarray(sheet) == (0, 255, 255)).all(axis=-1).sum() > 1000


def test_the_command_says_what_is_wrong(bench, tmp_path):
    folder, calibration, _ = bench
    (folder / "side.jpg").unlink()
    command = [
        "reconstruct",
        str(folder),
        "--calibration",
        str(calibration),
        "--out",
        str(tmp_path / "out"),
    ]
    result = runner.invoke(app, command)
    assert result.exit_code == 1
    assert "must hold one picture side.png or side.jpg" in result.output
    assert not (tmp_path / "out").exists()


def test_a_wrong_calibration_names_field_rule_and_value(bench):
    folder, calibration, _ = bench
    text = calibration.read_text()
    calibration.write_text(text.replace("width = 224", "width = 0", 1))
    with pytest.raises(
        ReconstructionError, match=r"bench\.cameras\.0\.width: .*greater than or equal to 1; got 0"
    ):
        reconstruct_folder(folder, calibration, length=1.0)
    calibration.write_text("width = ")
    with pytest.raises(ReconstructionError, match=r"calibration\.toml: not TOML"):
        read_calibration(calibration)
    calibration.write_text(text + text.replace("bench", "table"))
    with pytest.raises(ReconstructionError, match=r"several; .* has bench, table"):
        read_calibration(calibration)
    assert len(read_calibration(calibration, "table")) == 4
