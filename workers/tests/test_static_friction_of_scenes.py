"""Static and kinetic friction in the document of a scene and on the axes of a drag."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.files import with_arrays
from stickslip_sim_core.scenes import cloth_drag, cloth_scene

LEANING = [3.924, 0.0, -9.81]
"""Gravity on a slope of 0.4 [m/s^2]."""


def positions(friction: dict[str, float], body: dict[str, Any]) -> NDArray[np.float32]:
    document = {
        "format": "stickslip-scene/1",
        "duration": 0.4,
        "preset": "certified",
        "gravity": LEANING,
        "sheets": {
            "cloth": {
                "material": "gray-interlock",
                "mesh": {"type": "grid", "size": [0.1, 0.1], "cells": [4, 4]},
                "self_contact": False,
            },
        },
        "bodies": {"floor": body},
        "friction": [{"between": ["cloth", "floor"], **friction}],
    }
    physics = with_arrays(Scene.model_validate(document), lambda _name: b"")
    (outcome,) = cloth_scene.KIND.simulate([{"scene": physics, "seed": 0}], None)
    assert outcome.reason == ""
    return np.asarray(outcome.record["cloth.positions"])


@pytest.mark.parametrize(
    "body",
    [{"type": "plane"}, {"type": "box", "size": [2.0, 2.0, 0.1], "origin": [0.0, 0.0, -0.05]}],
    ids=["plane", "box"],
)
def test_scene_holds_by_the_static_coefficient_and_slides_by_the_kinetic_one(
    body: dict[str, Any],
) -> None:
    held = positions({"static": 0.42, "kinetic": 0.3}, body)
    assert np.abs(held[-1] - held[0]).max() == 0.0
    slides = positions({"static": 0.38, "kinetic": 0.3}, body)
    same = positions({"mu": 0.3}, body)
    assert (slides[-1] - slides[0])[:, 0].min() > 0.06
    np.testing.assert_allclose(slides, same, rtol=0.0, atol=2e-6)


def test_both_coefficients_alike_are_mu_bit_by_bit() -> None:
    of_mu = positions({"mu": 0.3}, {"type": "plane"})
    of_both = positions({"static": 0.3, "kinetic": 0.3}, {"type": "plane"})
    assert np.array_equal(of_mu, of_both)


def test_ratio_of_a_drag_reaches_its_floor() -> None:
    physics = {
        "material": "gray-interlock",
        "fabric": None,
        "mu": 0.4,
        "preset": "certified",
        "mesh": 9,
        "frames": 50,
        "seed": 0,
        "self_friction": 0.5,
    }
    runs = []
    for ratio in (None, 1.0, 1.3):
        factor = {} if ratio is None else {"static_ratio": ratio}
        (outcome,) = cloth_drag.KIND.simulate([{**physics, **factor}], None)
        runs.append(outcome.record["positions"])
    assert np.array_equal(runs[0], runs[1])
    assert np.abs(runs[2] - runs[0]).max() > 1e-4
