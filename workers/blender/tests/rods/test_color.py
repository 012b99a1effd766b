"""Colours are a function of the seed alone."""

import colorsys

import numpy as np
import pytest
from stickslip_blender.scenes.rod_hang import silicone_color, to_linear


def test_a_seed_has_one_color() -> None:
    assert silicone_color(7) == silicone_color(7)
    assert len({silicone_color(seed) for seed in range(200)}) > 195


def test_colors_do_not_change_between_releases() -> None:
    assert [round(255 * channel) for channel in silicone_color(0)] == [62, 83, 182]


def test_colors_are_bright_saturated_and_of_every_hue() -> None:
    hsv = np.array([colorsys.rgb_to_hsv(*silicone_color(seed)) for seed in range(500)])
    assert hsv[:, 1].min() > 0.54
    assert hsv[:, 2].min() > 0.69
    assert np.histogram(hsv[:, 0], bins=6, range=(0, 1))[0].min() > 50


@pytest.mark.parametrize(
    ("encoded", "linear"), [(0.0, 0.0), (0.5, 0.21404), (0.04, 0.0030960), (1.0, 1.0)]
)
def test_to_linear_is_the_srgb_curve(encoded: float, linear: float) -> None:
    assert to_linear((encoded, encoded, encoded))[0] == pytest.approx(linear, abs=1e-5)
