"""Cameras: projection against a pinhole written out by hand, framing, the shipped rigs."""

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from stickslip_schemas.spec.cameras import Camera, load_rig, read_rigs, rig_digest, rig_names
from stickslip_testing.cameras import looking_at

LEVEL = Camera(  # three units in front of the origin on the x axis, looking back at it
    name="level",
    width=200,
    height=100,
    fx=300.0,
    fy=310.0,
    cx=90.0,
    cy=60.0,
    rotation=((0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (-1.0, 0.0, 0.0)),
    translation=(0.0, 0.0, 3.0),
)


def test_project_matches_the_pinhole_by_hand() -> None:
    pixels, depth = LEVEL.project([[0.0, 0.0, 0.0], [1.0, 0.2, 0.1]])
    assert depth.tolist() == [3.0, 2.0]
    np.testing.assert_allclose(pixels, [[90.0, 60.0], [90.0 + 300.0 * 0.1, 60.0 - 310.0 * 0.05]])


def test_project_keeps_leading_dimensions() -> None:
    pixels, depth = LEVEL.project(np.zeros((4, 5, 3)))
    assert pixels.shape == (4, 5, 2)
    assert depth.shape == (4, 5)


def test_a_point_behind_the_camera_has_no_image() -> None:
    pixels, depth = LEVEL.project([[4.0, 0.0, 0.0]])
    assert depth[0] < 0.0
    assert np.isnan(pixels).all()
    assert LEVEL.overflow([[4.0, 0.0, 0.0]]) == np.inf
    assert LEVEL.overflow([[4.0, 0.0, 0.0]]) > 0.0


@pytest.mark.parametrize("radius", [0.5, 0.999999, 1.0, 2.0])
def test_a_ball_that_reaches_the_camera_leaves_the_frame(radius: float) -> None:
    """The plane of the camera is 1 before the middle of the ball, which alone would be in sight."""
    ball = [[2.0, 0.0, 0.0]]
    _, depth = LEVEL.project(ball)
    assert depth.tolist() == pytest.approx([1.0])
    assert LEVEL.overflow(ball) < 0.0
    overflow = LEVEL.overflow(ball, radius=radius)
    # In front of the camera it has an image, however large; otherwise it has none.
    assert (overflow == np.inf) == (radius >= 1.0)


def test_position_is_where_the_depth_vanishes() -> None:
    np.testing.assert_allclose(LEVEL.position, [3.0, 0.0, 0.0])
    assert LEVEL.project(LEVEL.position)[1] == 0.0


@pytest.mark.parametrize(
    ("point", "radius", "margin", "expected"),
    [
        ([0.0, 0.0, 0.0], 0.0, 0.0, 60.0 - 99.5),  # the lower edge is the nearest
        ([0.0, 0.0, 0.0], 0.03, 0.0, 60.0 - 99.5 + 3.1),
        ([0.0, 0.0, 0.0], 0.03, 2.0, 60.0 - 99.5 + 5.1),
        ([0.0, -1.0, 0.0], 0.0, 0.0, -0.5 + 10.0),  # column -10
        ([0.0, 0.0, 1.0], 0.0, 0.0, -0.5 + 130.0 / 3.0),  # row 60 - 103.3
    ],
)
def test_overflow_is_measured_in_pixels(
    point: list[float], radius: float, margin: float, expected: float
) -> None:
    assert LEVEL.overflow([point], radius, margin) == pytest.approx(expected)


def test_one_point_outside_is_enough() -> None:
    assert LEVEL.overflow([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) > 0.0


def test_looking_at_puts_the_target_in_the_middle_and_up_on_top() -> None:
    camera = looking_at(
        (0.1, -0.2, 0.3),
        azimuth=30.0,
        elevation=20.0,
        distance=2.0,
        name="a",
        width=64,
        height=48,
        focal=80.0,
    )
    (middle, above), depth = camera.project([[0.1, -0.2, 0.3], [0.1, -0.2, 0.4]])
    np.testing.assert_allclose(middle, [31.5, 23.5])
    assert depth[0] == pytest.approx(2.0)
    assert above[0] == pytest.approx(31.5)
    assert above[1] < 23.5
    offset = np.subtract(camera.position, (0.1, -0.2, 0.3))
    assert np.degrees(np.arctan2(offset[1], offset[0])) == pytest.approx(30.0)
    assert np.degrees(np.arcsin(offset[2] / 2.0)) == pytest.approx(20.0)


@pytest.mark.parametrize(
    "rotation",
    [
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),  # a mirror
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.01), (0.0, 0.0, 1.0)),  # sheared
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, float("nan"))),
    ],
)
def test_only_rotations_are_rotations(rotation: tuple[tuple[float, ...], ...]) -> None:
    with pytest.raises(ValidationError, match="rotation"):
        Camera.model_validate(LEVEL.model_dump() | {"rotation": rotation})


def test_a_camera_survives_json_unchanged() -> None:
    assert Camera.model_validate_json(LEVEL.model_dump_json()) == LEVEL


def test_rod_4_is_four_upright_views_that_never_face_each_other() -> None:
    rig = load_rig("rod-4")
    assert {"drag", "rod-4"} <= set(rig_names())
    assert [camera.name for camera in rig] == ["front", "side", "high", "low"]
    for camera in rig:
        assert (camera.width, camera.height) == (224, 224)
        (middle, top), _ = camera.project([[0.0, 0.0, -0.5], [0.0, 0.0, 0.0]])
        np.testing.assert_allclose(middle, [111.5, 111.5], atol=1e-6)
        assert top[0] == pytest.approx(111.5, abs=1e-6)
        assert top[1] < 20.0
    azimuths = [float(np.degrees(np.arctan2(*camera.position[1::-1]))) for camera in rig]
    np.testing.assert_allclose(
        np.sort(np.mod(azimuths, 180.0)), [0.0, 45.0, 90.0, 135.0], atol=1e-6
    )


def test_rod_4_holds_every_rod_of_the_thesis_grid() -> None:
    # Envelope of 1,200 solved rods over the grid, rounded up: down to z, the reach from the
    # vertical axis [L].
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for z, reach in (
        (-0.05, 0.12),
        (-0.1, 0.14),
        (-0.6, 0.21),
        (-0.9, 0.31),
        (-0.95, 0.21),
        (-0.99, 0.13),
    ):
        points = np.column_stack([reach * ring, np.full(len(ring), z)])
        for camera in load_rig("rod-4"):
            assert camera.overflow(points, radius=0.008, margin=1.0) <= 0.0, (camera.name, z)


def test_the_digest_of_a_rig_changes_only_on_purpose() -> None:
    # It is in the content key of every picture: new numbers here mean that all of them are rendered
    # again.
    assert rig_digest("rod-4") == "7f05db0f5bd5091e8af78f9fbeb82fb6cd977bfd2a3a3f79a15e0cb0d2e0932c"


def test_drag_is_the_viewpoints_and_holds_the_stage() -> None:
    rig = load_rig("drag")
    names = [
        camera.name for camera in rig
    ]  # in the order of their codes, to which names may only be added
    assert names[:5] == ["calibrated", "left", "right", "azimuth-minus-15", "azimuth-minus-10"]
    assert (names[9], names[14]) == ("elevation-minus-15", "elevation-plus-15")
    # After the drop by 6 cm, the lower edge lies up to 6 cm from the plane of the holders. Then
    # friction holds it back, so it is never further out than where it lay or where the holders have
    # been, and 7 cm.
    floor = [(x, y, 0.0) for x in (-0.07, 0.37) for y in (-0.11, 0.11)]
    held = [(x, y, 0.15) for x in (0.0, 0.3) for y in (-0.105, 0.105)] + [
        (0.0, y, 0.21) for y in (-0.105, 0.105)
    ]
    for camera in rig:
        assert camera.overflow(floor + held, margin=1.0) <= 0.0, camera.name
    for camera in rig[:3]:
        pixels, _ = camera.project(floor + held)
        assert np.ptp(pixels, axis=0).max() > 190.0  # and the frame is not wider than it must be


def test_an_unknown_rig_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"rig must be one of drag, rod-4; got 'rod-5'"):
        load_rig("rod-5")


def test_a_calibration_file_reads_like_the_shipped_one(tmp_path: Path) -> None:
    text = files("stickslip_schemas").joinpath("rigs", "rod-4.toml").read_text(encoding="utf-8")
    file = tmp_path / "mine.toml"
    file.write_text(text.replace("[rod-4", "[mine"), encoding="utf-8")
    assert read_rigs(file)["mine"] == load_rig("rod-4")
    file.write_text(text.replace('name = "side"', 'name = "front"'), encoding="utf-8")
    with pytest.raises(ValidationError, match="camera names must be unique"):
        read_rigs(file)


PHONE = (-0.28, 0.09, 0.0012, -0.0008, 0.01)


def test_a_lens_moves_points_as_opencv_says() -> None:
    """Numbers of cv2.projectPoints, for x, y = 0.1, -0.05 and 0.3, 0.2."""
    camera = LEVEL.model_copy(update={"distortion": PHONE})
    pixels, _ = camera.project([[0.0, 0.3, 0.15], [0.0, 0.9, -0.6]])
    np.testing.assert_allclose(
        pixels, [[119.884022, 44.563022], [176.831667, 119.887224]], atol=1e-5
    )


def test_rays_and_pinhole_undo_the_lens() -> None:
    for lens in (PHONE, (0.2, 0.05, -0.001, 0.001, 0.0)):
        camera = LEVEL.model_copy(update={"distortion": lens})
        rays = camera.rays()
        world = (rays * 2.0 - camera.translation) @ np.asarray(camera.rotation)
        pixels, _ = camera.project(world)
        rows, columns = np.mgrid[:100, :200]
        np.testing.assert_allclose(pixels, np.stack([columns, rows], axis=-1), atol=1e-7)
        pinhole = camera.pinhole()
        places, _ = pinhole.project(world)
        assert places.min() >= 0.0
        assert (places <= (pinhole.width - 1, pinhole.height - 1)).all()
        assert (pinhole.fx, pinhole.distortion) == (camera.fx, (0.0,) * 5)
    assert LEVEL.pinhole() is LEVEL


def test_a_lens_has_none_four_or_five_numbers() -> None:
    numbers = LEVEL.model_dump()
    assert Camera.model_validate(numbers | {"distortion": []}).distortion == (0.0,) * 5
    assert Camera.model_validate(numbers | {"distortion": [1, 2, 3, 4]}).distortion == (
        1.0,
        2.0,
        3.0,
        4.0,
        0.0,
    )
    with pytest.raises(ValidationError, match="distortion"):
        Camera.model_validate(numbers | {"distortion": [0.1]})


def test_what_a_lens_folds_into_its_picture_is_out_of_the_frame() -> None:
    camera = LEVEL.model_copy(update={"distortion": (-0.3, 0.0, 0.0, 0.0, 0.0)})
    pixels, _ = camera.project([[0.0, 5.4, 0.0]])  # 61 degrees off the axis
    assert 0.0 < pixels[0, 0] < 200.0
    assert camera.overflow([[0.0, 5.4, 0.0]]) > 200.0
