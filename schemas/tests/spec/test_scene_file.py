"""Scene files: what is refused, and the field, the rule and the value that the refusal names."""

from copy import deepcopy
from typing import Any

import pytest
from pydantic import ValidationError
from stickslip_schemas.spec.scene_file import SceneFile

SCENE: dict[str, Any] = {
    "format": "stickslip-scene/1",
    "duration": 2.0,
    "materials": {"felt": {"density": 0.3, "young": 1e6, "poisson": 0.3, "thickness": 1e-3}},
    "sheets": {
        "lower": {
            "material": "gray-interlock",
            "mesh": {"type": "grid", "size": [0.2, 0.1], "cells": [8, 4]},
            "origin": [0, 0, 0.01],
        },
        "upper": {
            "material": "felt",
            "mesh": {"type": "unstructured", "size": [0.1, 0.1], "spacing": 0.02},
            "origin": [0, 0, 0.02],
            "holders": {"hand": {"low": [-0.05, -0.05], "high": [0.0, 0.05], "motion": {"keys": [{"time": 0}]}}},
        },
    },
    "bodies": {
        "floor": {"type": "plane"},
        "ball": {"type": "sphere", "radius": 0.05, "origin": [0, 0, 0.5]},
        "actor": {"type": "mesh", "file": "actor.npz"},
    },
    "friction": [
        {"between": ["lower", "lower"], "mu": 0.1},
        {"between": ["upper", "lower"], "mu": 0.2},
        {"between": ["upper", "upper"], "mu": 0.3},
        {"between": ["floor", "lower"], "mu": 0.4},
        {"between": ["floor", "upper"], "mu": 0.4},
        {"between": ["ball", "lower"], "mu": 0.5},
        {"between": ["ball", "upper"], "mu": 0.5},
        {"between": ["lower", "actor"], "mu": 0.6},
        {"between": ["upper", "actor"], "mu": 0.7},
    ],
}


def changed(place: str, value: Any) -> dict[str, Any]:
    """Return the scene with another value at a place: keys and positions, with points between."""
    scene = deepcopy(SCENE)
    *path, last = place.split(".")
    at: Any = scene
    for step in path:
        at = at[int(step)] if isinstance(at, list) else at[step]
    if value is None:
        del at[int(last) if isinstance(at, list) else last]
    else:
        at[int(last) if isinstance(at, list) else last] = value
    return scene


def test_a_scene_is_read_and_written() -> None:
    scene = SceneFile.model_validate(SCENE)
    assert scene.frames == 61
    assert scene.sheets["lower"].mesh.vertices == 45
    assert scene.mu("lower", "upper") == scene.mu("upper", "lower") == 0.2
    assert scene.mu("upper", "upper") == 0.3
    assert scene.mu("upper", "actor") == 0.7
    assert SceneFile.model_validate_json(scene.model_dump_json()) == scene


def test_a_default_stands_for_what_is_not_named() -> None:
    scene = SceneFile.model_validate(changed("friction.1", None) | {"default_friction": 0.9})
    assert scene.mu("lower", "upper") == 0.9
    assert scene.mu("lower", "floor") == 0.4


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("format", "stickslip-scene/2", "Input should be 'stickslip-scene/1'"),
        ("duration", 0.0, "Input should be greater than 0"),
        ("duration", 1e4, "must be at most 10000 frames, and they are 300001"),
        ("sheets", {}, "at least 1 item"),
        ("sheets.lower.material", "silk", "sheets.lower.material must be one of 11oz-black-denim.*, felt, got 'silk'"),
        ("sheets.lower.mesh.cells", [8, 0], "greater than or equal to 1"),
        ("sheets.upper.mesh.spacing", 1e-4, "must have at most 100000 vertices"),
        ("sheets.upper.holders.hand.low", [0.1, 0.0], "low must be at most high in both"),
        (
            "sheets.upper.holders.hand.motion.keys",
            [{"time": 1}, {"time": 0.5}],
            "keys must ascend in time, and 0.5 s comes after 1 s",
        ),
        ("sheets.upper.holders.hand.motion.keys", [], "at least 1 item"),
        ("materials.gray-interlock", SCENE["materials"]["felt"], "must not redefine what is built in"),
        ("bodies.ball.radius", -1.0, "greater than 0"),
        ("bodies.ball.type", "cube", "does not match any of the expected tags"),
        ("bodies.floor.normal", [0, 0, 0], "normal must not be 0"),
        ("bodies.lower", {"type": "plane"}, "must have names of their own, and 'lower' is both"),
        ("friction.0", None, "default_friction must be given, and lower with lower is not there"),
        (
            "friction.0.between",
            ["lower", "wall"],
            r"friction.0.between must name two that may touch, got \['lower', 'wall'\]",
        ),
        ("friction.0.between", ["floor", "ball"], "must name two that may touch"),
        ("friction.0.between", ["lower", "upper"], r"friction.1.between must name two once, got \['upper', 'lower'\]"),
        ("friction.3.mu", 0.1, "friction of floor, a plane, must be the same with all sheets, got 0.1, 0.4"),
        ("friction.3.mu", 11, "less than or equal to 10"),
        ("wind", 1.0, "Extra inputs are not permitted"),
    ],
)
def test_what_is_refused(place: str, value: Any, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        SceneFile.model_validate(changed(place, value))
