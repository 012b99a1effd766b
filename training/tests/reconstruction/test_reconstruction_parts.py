"""The parts of the reconstruction, one by one; derivatives against finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from stickslip_schemas.spec.cameras import load_rig
from stickslip_training.reconstruction.refinement import _Problem, draw, samples, start
from stickslip_training.reconstruction.starts import follow, moving_cylinder, visual_hull
from stickslip_training.reconstruction.views import (
    ReconstructionError,
    View,
    arc_length,
    at_uniform_arc_length,
    fit_curve,
    silhouette,
    to_linear,
    tube_image,
)

RADIUS = 0.008
DOWN = np.array([0.0, 0.0, -1.0])


def helix(turns=2.0, opening=0.9, count=150):
    s = np.linspace(0.0, 1.0, 20 * (count - 1) + 1)
    tilt, turn = opening * np.sin(0.5 * np.pi * s), 2.0 * np.pi * turns * s
    tangent = np.stack(
        [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)], axis=1
    )
    steps = 0.5 * (tangent[1:] + tangent[:-1]) * (s[1] - s[0])
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])[::20]


def empty_views():
    return [
        View.of(camera, np.zeros((224, 224)), length=1.0, clamp=(0, 0, 0))
        for camera in load_rig("rod-4")
    ]


@pytest.fixture(scope="module")
def line():
    return helix()


@pytest.fixture(scope="module")
def views(line):
    """The helix as the drawing itself would have it."""
    fit = start(fit_curve(line, 44), RADIUS, 4)
    drawn = []
    for index, view in enumerate(empty_views()):
        image = draw(view, index, fit, samples([view], fit))
        coverage = np.zeros(view.coverage.size)
        coverage[image.pixel] = image.value
        drawn.append(replace(view, coverage=coverage.reshape(view.coverage.shape)))
    return drawn


def strip(slope=0.3, half=2.0, at=30.0):
    """Exact enough coverage of a slanted strip across a picture of 64 x 64 pixels."""
    y, x = (np.mgrid[0:640, 0:640] + 0.5) / 10 - 0.5
    inside = np.abs(x - at - slope * (y - 32)) < half * np.hypot(1.0, slope)
    return inside.reshape(64, 10, 64, 10).mean(axis=(1, 3))


@pytest.mark.parametrize("color", [(0.8, 0.1, 0.1), (0.1, 0.3, 0.9), (0.02, 0.02, 0.01)])
def test_a_silhouette_has_the_area_of_the_strip_whatever_its_colour(color):
    share = strip()
    light = 0.002 + share[..., None] * np.array(color)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    coverage = silhouette(to_linear(np.rint(255 * encoded).astype(np.uint8)))
    rows = slice(8, -8)  # at the frame the brightness about a pixel is one-sided
    np.testing.assert_allclose(coverage[rows].sum(axis=1), share[rows].sum(axis=1), rtol=0.12)
    middle = (coverage[rows] * np.arange(64)).sum(axis=1) / coverage[rows].sum(axis=1)
    np.testing.assert_allclose(middle, 30.0 + 0.3 * (np.arange(8, 56) - 32), atol=0.05)


def test_sixteen_bits_floats_and_grey_pictures_are_the_same_picture():
    grey = np.rint(255 * strip()).astype(np.uint8)
    expected = silhouette(to_linear(np.repeat(grey[..., None], 3, axis=2)))
    for picture in (grey, grey[..., None], grey.astype(np.uint16) * 257, grey / 255.0):
        np.testing.assert_allclose(silhouette(to_linear(picture)), expected, atol=1e-6)


def test_dirt_is_no_rod_and_no_rod_is_an_error():
    picture = strip()
    dirty = picture.copy()
    dirty[50:52, 5:7] = 1.0
    assert silhouette(to_linear(dirty))[45:56, :10].max() == 0.0
    random = np.random.default_rng(0)
    with pytest.raises(ReconstructionError, match="must show a rod brighter than its ground"):
        silhouette(to_linear(0.2 + 0.01 * random.standard_normal((64, 64))))
    with pytest.raises(
        ValueError, match=r"shape \(y, x\), \(y, x, 1\) or \(y, x, 3\); got \(64,\)"
    ):
        to_linear(np.zeros(64))


def test_views_project_as_cameras_do(line):
    for camera, view in zip(load_rig("rod-4"), empty_views(), strict=True):
        np.testing.assert_allclose(view.project(line)[0], camera.project(line)[0], atol=1e-9)
        smaller = view.shrunk(2)
        np.testing.assert_allclose(
            smaller.project(line)[0], (camera.project(line)[0] + 0.5) / 2 - 0.5, atol=1e-9
        )
        step = 1e-6
        for axis in range(3):
            moved = line + step * np.eye(3)[axis]
            back = line - step * np.eye(3)[axis]
            difference = (view.project(moved)[0] - view.project(back)[0]) / (2 * step)
            np.testing.assert_allclose(
                view.gradient(line)[..., axis], difference, rtol=1e-6, atol=1e-5
            )


def test_a_spline_is_at_uniform_arc_length(line):
    control = fit_curve(line, 44)
    points = at_uniform_arc_length(control, 150)
    assert np.linalg.norm(points - line, axis=1).max() < 2e-4
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=1e-3)


def test_the_drawing_changes_as_its_derivatives_say():
    """Along a straight rod, where the nearest sample of a pixel does not jump as the rod moves."""
    view = empty_views()[1]
    points = np.linspace((0.0, 0.0, 0.0), (0.02, 0.01, -0.9), 400)
    bright, tilted = (
        1.0 + 0.2 * np.sin(np.linspace(0, 3, 400)),
        0.3 * np.cos(np.linspace(0, 3, 400)),
    )

    def value(shift=0.0, grow=0.0, blur=0.0, light=0.0, slope=0.0):
        image = tube_image(
            view,
            points + shift * np.array([1.0, 0.0, 0.0]),
            RADIUS * np.exp(grow),
            0.5 * np.exp(blur),
            bright + light,
            tilted + slope,
        )
        drawn = np.full(view.coverage.size, np.nan)
        drawn[image.pixel] = image.value
        return drawn, image

    _, image = value()
    front = image.sides[0]
    derivatives = {
        "shift": front.by_point[:, 0],
        "grow": front.by_radius,
        "blur": front.by_blur,
        "light": front.by_light,
        "slope": front.by_slope,
    }
    step = 1e-5
    inner = (front.sample > 5) & (front.sample < 390)
    for name, derivative in derivatives.items():
        difference = (value(**{name: step})[0] - value(**{name: -step})[0])[image.pixel] / (
            2 * step
        )
        known = inner & np.isfinite(difference)
        assert known.sum() > 500
        scale = np.abs(difference[known]).max()
        np.testing.assert_allclose(derivative[known], difference[known], atol=1e-2 * scale)


@pytest.mark.physics
def test_the_cost_falls_as_its_gradient_says(views, line):
    fit = start(fit_curve(line, 44), 1.1 * RADIUS, 4)
    fit = replace(fit, control=fit.control + 0.002 * np.sin(np.arange(132).reshape(44, 3)))
    problem = _Problem(views, fit, DOWN, 0.0, True, False)
    x = problem.pack(fit)
    system = problem.system(x)
    random = np.random.default_rng(1)
    for _ in range(3):
        toward = random.standard_normal(len(x)) * np.where(np.arange(len(x)) < 132, 1e-5, 1e-4)
        change = (problem.system(x + toward).cost - problem.system(x - toward).cost) / 2.0
        assert change == pytest.approx(
            float(system.gradient @ toward), rel=0.05, abs=0.02 * abs(system.gradient) @ abs(toward)
        )


@pytest.mark.physics
def test_the_hull_holds_the_rod_and_little_else(views, line):
    cloud = visual_hull(views)
    gaps = np.linalg.norm(line[:, None] - cloud, axis=-1).min(axis=1)
    assert gaps.max() < RADIUS
    nearest = np.linalg.norm(cloud[:, None] - line, axis=-1).min(axis=1)
    assert np.quantile(nearest, 0.9) < 2.0 * RADIUS
    full = [replace(view, coverage=np.ones_like(view.coverage)) for view in views]
    assert len(visual_hull(full)) == 0


def test_the_moving_cylinder_follows_a_gentle_rod(views, line):
    walked = moving_cylinder(visual_hull(views), RADIUS, DOWN)
    assert np.linalg.norm(walked[:, None] - line, axis=-1).min(axis=1).max() < 2.0 * RADIUS
    assert arc_length(walked)[-1] == pytest.approx(1.0, abs=0.05)


def test_tracking_goes_to_the_free_end(views, line):
    tracks = follow(views, RADIUS, DOWN)
    assert np.linalg.norm(tracks[0][-1] - line[-1]) < 0.02
