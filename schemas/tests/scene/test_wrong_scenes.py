"""Wrong scenes: each is refused with the path, the rule, the value and, of a number, the unit."""

import json
import re
from copy import deepcopy
from typing import Any

import pytest
from pydantic import ValidationError
from stickslip_schemas.documents.problems import field_errors
from stickslip_schemas.scene.document import Scene

DIGEST = f"sha256:{'a' * 64}"
SCENE: dict[str, Any] = {
    "format": "stickslip-scene/1",
    "duration": 2.0,
    "bias": {"size": 0.001, "until": 1.0},
    "calm": {"until": 1.0, "rate": 2.0},
    "materials": {"felt": {"density": 0.3, "young": 1e6, "poisson": 0.3, "thickness": 1e-3}},
    "parameters": {
        "mu": {"low": 0, "high": 2, "sets": ["friction.ball.lower"]},
        "static": {"low": 0.4, "high": 2, "sets": ["friction.rod.upper.static"]},
        "fabric": {"sets": ["sheets.lower.material"]},
        "speed": {"unit": "rad/s", "low": -5, "high": 5, "sets": ["bodies.ball.motion.spin.speed"]},
    },
    "sheets": {
        "lower": {
            "material": "gray-interlock",
            "mesh": {"type": "grid", "size": [0.2, 0.1], "cells": [8, 4]},
            "origin": [0, 0, 0.01],
            "start": {"type": "stretched", "strain": [0.01, 0.02]},
            "holders": {"rim": {"rim": True, "grasp": [0.0, 1.0]}},
        },
        "upper": {
            "material": "felt",
            "mesh": {"type": "unstructured", "size": [0.1, 0.1], "spacing": 0.02},
            "origin": [0, 0, 0.02],
            "holders": {
                "hand": {
                    "low": [-0.05, -0.05],
                    "high": [0.0, 0.05],
                    "motion": {"keys": [{"time": 0}, {"time": 1, "move": [0, 0, 0.1]}]},
                }
            },
        },
        "towel": {"material": "felt", "mesh": {"type": "file", "file": DIGEST, "counts": [9, 8]}},
    },
    "bodies": {
        "floor": {"type": "plane"},
        "ball": {
            "type": "sphere",
            "radius": 0.05,
            "origin": [0, 0, 0.5],
            "motion": {"spin": {"speed": 1.0, "begin": 0.5, "ramp": 0.5}},
        },
        "rod": {"type": "capsule", "radius": 0.01, "length": 0.2, "origin": [0, 0, 0.9]},
        "block": {"type": "box", "size": [0.1, 0.1, 0.02], "rounding": 0.005, "origin": [1, 0, 0]},
        "actor": {"type": "mesh", "file": "actor.npz", "strength": 1.0},
    },
    "friction": [
        {"between": ["lower", "ball"], "mu": 0.5},
        {"between": ["upper", "lower"], "mu": 0.2},
        {"between": ["upper", "rod"], "static": 0.5, "kinetic": 0.35},
    ],
    "default_friction": 0.4,
    "looks": {
        "sheets": {"upper": {"texture": "plaid"}},
        "bodies": {"ball": {"color": [1, 0, 0], "roughness": 0.2}},
        "cameras": {"door": {"position": [1, 1, 1], "target": [0, 0, 0], "focal_length": 50}},
    },
}

GONE = object()
NAN, FAR = float("nan"), 1000.0
UPPER, LOWER, BALL = "sheets.upper", "sheets.lower", "bodies.ball"
SPIN, KEYS = f"{BALL}.motion.spin", f"{UPPER}.holders.hand.motion.keys"

# Where, what stands there, the place that the answer names (empty: the same), a part of the rule
# with its unit, and the value that is shown, where it is not what stands at the place that the
# answer names.
WRONG: list[tuple[Any, ...]] = [
    ("format", "stickslip-scene/2", "", "must be one of stickslip-scene/1"),
    ("format", GONE, "", "this field is required"),
    ("sheets", GONE, "", "this field is required"),
    ("sheets", {}, "", "must have at least 1 item"),
    ("gravty", [0, 0, 0], "", "did you mean gravity"),
    ("duration", -1.0, "", "greater than 0 [s]"),
    ("duration", NAN, "", "finite number [s]"),
    ("duration", "2 s", "", "valid number [s]"),
    ("duration", GONE, "", "one of duration [s] and end must be given", "null"),
    ("end", {"when": "rest", "at_most": 3.0}, "duration", "and not both"),
    (
        "duration",
        9999.0,
        "frame_rate",
        "length [s] times frame_rate [1/s] must be at most 10000 frames",
        "30.0",
    ),
    ("frame_rate", 0, "", "greater than 0 [1/s]"),
    ("gravity", [0, 0, -FAR], "gravity.2", "greater than or equal to -100 [m/s^2]"),
    ("gravity", [0, -9.81], "gravity.2", "this field is required"),
    ("preset", "quick", "", "must be one of certified"),
    ("bearing", "second", "", "must be one of all"),
    ("bias.size", -0.1, "", "greater than or equal to 0"),
    ("bias.until", -1.0, "", "greater than or equal to 0 [s]"),
    ("calm.rate", 1e4, "", "less than or equal to 1000 [1/s]"),
    ("materials.felt.density", 9.0, "", "less than or equal to 5 [kg/m^2]"),
    (
        "materials.gray-interlock",
        {"density": 0.1, "young": 1e6, "poisson": 0.3, "thickness": 1e-3},
        "",
        "redefine",
        '"gray-interlock"',
    ),
    (
        "materials.Felt",
        {"density": 0.1, "young": 1e6, "poisson": 0.3, "thickness": 1e-3},
        "",
        "lower-case letters",
        '"Felt"',
    ),
    (f"{UPPER}.material", "fellt", "", "did you mean felt"),
    (
        f"{UPPER}.origin",
        [0, 0, FAR],
        f"{UPPER}.origin.2",
        "less than or equal to 100 [m]; did you mean mm?",
    ),
    (f"{UPPER}.turn", [0, 0, 90.0], f"{UPPER}.turn.2", "mean degrees? 90 degrees are 1.5708 rad"),
    (f"{UPPER}.thickness", 0.5, "", "did you mean mm? 0.5 mm are 0.0005 m"),
    (f"{UPPER}.turn", [0, 0, 2000.0], f"{UPPER}.turn.2", "less than or equal to 6.2832 [rad]"),
    (f"{UPPER}.thickness", 0.0, "", "greater than or equal to 0.00001 [m]"),
    (
        f"{UPPER}.mesh.size",
        [80, 60],
        "",
        "the longer side must be 0.001 to 10 m, and is 80 m; did you mean mm? Lengths are in "
        "metres, and 80 mm are 0.08",
        "[80.0, 60.0]",
    ),
    (
        f"{LOWER}.mesh.size",
        [8e-5, 4e-5],
        "",
        "the longer side must be 0.001 to 10 m, and is 8e-05 m; did you mean 0.08 m?",
    ),
    (f"{UPPER}.self_contact", False, "", "must be true if there are several sheets"),
    (
        f"{UPPER}.factors",
        {"density": 0.01},
        f"{UPPER}.factors.density",
        "greater than or equal to 0.1",
    ),
    (f"{UPPER}.mesh", {"type": "hexagons"}, f"{UPPER}.mesh.type", "must be one of"),
    (f"{UPPER}.mesh.spacing", -0.02, "", "greater than 0 [m]"),
    (f"{UPPER}.mesh.spacing", 1e-5, "sheets", "at most 100000 vertices", "115497375"),
    (f"{LOWER}.mesh.cells", [0, 4], f"{LOWER}.mesh.cells.0", "greater than or equal to 1"),
    (f"{LOWER}.mesh.cells", [8.5, 4], f"{LOWER}.mesh.cells.0", "integer"),
    (f"{LOWER}.mesh.size", [0.2, FAR], f"{LOWER}.mesh.size.1", "less than or equal to 100 [m]"),
    (f"{LOWER}.start", {"type": "hung", "bias_until": -1}, f"{LOWER}.start.bias_until", "[s]"),
    (f"{LOWER}.start.strain", [0.5, 0.0], f"{LOWER}.start.strain.0", "less than or equal to 0.2"),
    (f"{LOWER}.start", {"type": "file"}, LOWER, "start.file must name a file"),
    ("sheets.towel.start", {"type": "hung"}, "sheets.towel", "can be hung only from holders"),
    (
        "sheets.towel.start",
        {"type": "file", "file": "/etc/passwd"},
        "sheets.towel.start.file",
        "in the folder",
    ),
    ("sheets.towel.mesh.file", "../towel.obj", "", "in the folder of the scene"),
    ("sheets.towel.mesh.file", "sha256:12", "", "64 hexadecimal digits"),
    ("sheets.towel.mesh.file", "https://example.org/towel.obj", "", "in the folder of the scene"),
    (
        f"{LOWER}.holders.rim.low",
        [0, 0],
        f"{LOWER}.holders.rim",
        "one of low and high, edge, rim and vertices",
    ),
    (f"{LOWER}.holders.rim.rim", GONE, f"{LOWER}.holders.rim", "and it has none"),
    (f"{LOWER}.holders.rim.grasp", [1.0, 0.5], f"{LOWER}.holders.rim", "ascending order [s]"),
    (
        f"{LOWER}.holders.rim",
        {"vertices": [3, 45]},
        f"{LOWER}.holders.rim.vertices.1",
        "a vertex of the sheet",
    ),
    (f"{LOWER}.holders.rim", {"edge": "north"}, f"{LOWER}.holders.rim.edge", "must be one of left"),
    (
        f"{UPPER}.holders.hand.high",
        GONE,
        f"{UPPER}.holders.hand",
        "low and high must both be given",
    ),
    (
        f"{UPPER}.holders.hand.high",
        [-0.06, 0.05],
        f"{UPPER}.holders.hand",
        "low must be at most high in both [m]",
    ),
    (
        f"{KEYS}.1.time",
        0.0,
        f"{UPPER}.holders.hand.motion",
        "keys must ascend in time, and 0 s comes after 0 s",
    ),
    (f"{KEYS}.0.time", -1.0, "", "greater than or equal to 0 [s]"),
    (f"{KEYS}.1.move", [0, 0, FAR], f"{KEYS}.1.move.2", "less than or equal to 100 [m]"),
    (KEYS, [], "", "must have at least 1 item"),
    (
        f"{UPPER}.holders.hand.motion.path",
        "way.csv",
        f"{UPPER}.holders.hand.motion",
        "one of keys, spin and path",
    ),
    (
        f"{UPPER}.holders.hand.motion.ramp",
        0.1,
        f"{UPPER}.holders.hand.motion",
        "motion is not linear; ramp is 0.1 s",
    ),
    (f"{UPPER}.holders.hand.motion.interpolation", "cubic", "", "must be one of smooth"),
    (f"{SPIN}.axis", [0, 0, 0], SPIN, "axis must not be 0"),
    (f"{SPIN}.speed", 2000.0, "", "less than or equal to 1000 [rad/s]"),
    (f"{SPIN}.begin", -1.0, "", "greater than or equal to 0 [s]"),
    (f"{BALL}.radius", 0.0, "", "greater than or equal to 0.0001 [m]"),
    (f"{BALL}.radius", 80, "", "must be 0.0001 to 10 m; did you mean mm? Lengths are in metres"),
    (f"{BALL}.radius", 8e-5, "", "must be 0.0001 to 10 m; did you mean 0.08 m?"),
    (f"{BALL}.type", "ball", "", "must be one of plane"),
    (f"{BALL}.origin", GONE, "", "this field is required"),
    (f"{BALL}.size", [1, 1, 1], "", "there is no such field"),
    ("bodies.floor.normal", [0, 0, 0], "bodies.floor", "normal must not be 0"),
    ("bodies.rod.length", -0.2, "", "greater than 0 [m]"),
    ("bodies.block.rounding", 0.02, "bodies.block", "at most half the least of size, 0.01 m"),
    ("bodies.actor.strength", 3.0, "", "less than or equal to 2"),
    ("bodies.actor.file", "a\\b.obj", "", "in the folder of the scene"),
    ("bodies.actor.frame_rate", -1.0, "", "greater than 0 [1/s]"),
    ("bodies.upper", {"type": "plane"}, "", "names of their own", '"upper"'),
    ("friction.0.mu", 11.0, "", "less than or equal to 10"),
    ("friction.0.static", 0.6, "friction.0", "mu alone, or static and kinetic"),
    ("friction.0.mu", GONE, "friction.0", "must have mu, or both static and kinetic"),
    ("friction.2.static", 0.1, "friction.2", "kinetic must be at most static, and 0.35 is above"),
    ("friction.2.static", 11.0, "", "less than or equal to 10"),
    ("friction.2.kinetic", NAN, "", "finite number"),
    ("friction.2.kinetic", GONE, "friction.2", "must have mu, or both static and kinetic"),
    ("friction.0.between", ["ball", "floor"], "", "must name two that may touch"),
    ("friction.0.between", ["ball", "bal"], "", "must name two that may touch; did you mean ball"),
    ("friction.1.between", ["ball", "lower"], "", "must name two once"),
    ("default_friction", GONE, "friction", "missing: actor with lower", "null"),
    ("looks.sheets.napkin", {"texture": "dots"}, "", "must be one of lower", '"napkin"'),
    ("looks.bodies.bal", {"roughness": 0.5}, "", "did you mean ball", '"bal"'),
    ("looks.bodies.ball.color", [2, 0, 0], "looks.bodies.ball.color.0", "less than or equal to 1"),
    ("looks.cameras.door.position", [9, 1, 1], "looks.cameras.door", "within 4 m of the middle"),
    ("looks.cameras.door.focal_length", 5.0, "", "greater than or equal to 10 [mm]"),
    ("looks.cameras.door.target", [1, 1, 0], "looks.cameras.door", "straight above or below"),
    ("looks.cameras", "drags", "looks.cameras", "did you mean drag"),
    (
        "parameters.mu.sets",
        ["friction.ball.tower"],
        "parameters.mu.sets.0",
        "no pair of ball and tower",
    ),
    (
        "parameters.mu.sets",
        ["friction.rod.upper"],
        "parameters.mu.sets.0",
        "which has friction.rod.upper.static and friction.rod.upper.kinetic",
    ),
    (
        "parameters.mu.sets",
        ["friction.ball.lower.static"],
        "parameters.mu.sets.0",
        "which has one, friction.ball.lower",
    ),
    ("parameters.static.high", 20.0, "", "friction.2.static: must be less than or equal to 10"),
    ("parameters.static.low", 0.1, "", "kinetic must be at most static"),
    ("parameters.mu.high", 20.0, "", "friction.0.mu: must be less than or equal to 10"),
    ("parameters.mu.low", 3.0, "", "low below high"),
    ("parameters.mu.low", 1.0, "parameters.mu.sets.0", "a default within 1 to 2", "0.5"),
    ("parameters.speed.low", GONE, "", "low and high [rad/s] must be given", "null"),
    ("parameters.speed.sets", [f"{SPIN}.sped"], "parameters.speed.sets.0", "did you mean speed"),
    ("parameters.speed.unit", "rpm", "", "must be rad/s, as of bodies.ball.motion.spin.speed"),
    ("parameters.mu.unit", "N", "", "must be 1, as of friction.ball.lower"),
    ("parameters.speed.unit", GONE, "", "must be rad/s", '"1"'),
    ("parameters.fabric.low", 1.0, "", "for numbers without a list of values"),
    (
        "parameters.fabric.values",
        ["silk"],
        "parameters.fabric.sets.0",
        "default within silk",
        '"gray-interlock"',
    ),
    (
        "parameters.texture",
        {"sets": [f"{UPPER}.material"]},
        "",
        "name of an axis of all scenes",
        '"texture"',
    ),
    (
        "parameters.n",
        {"low": 1, "high": 9, "sets": [f"{LOWER}.mesh.cells.0"]},
        "parameters.n.sets.0",
        "shapes of",
    ),
    (
        "parameters.t",
        {"low": 1, "high": 9, "sets": ["duration"]},
        "parameters.t.sets.0",
        "shapes of arrays",
    ),
    (
        "parameters.f",
        {"sets": ["bodies.actor.file"]},
        "parameters.f.sets.0",
        "must lead to a number or a material",
    ),
    (
        "parameters.two",
        {"low": 0, "high": 1, "sets": ["friction.lower.ball"]},
        "parameters.two.sets.0",
        "where 'mu'",
    ),
    (
        "parameters.both",
        {"unit": "m", "low": 0.01, "high": 1, "sets": [f"{BALL}.radius", "bodies.rod.length"]},
        "parameters.both.sets",
        "must find one value",
    ),
]


PURE = {
    "Bias": {"size"},
    "BodyLook": {"color", "roughness"},
    "FabricNumbers": {"poisson"},
    "Factors": {"density", "bending", "stretching"},
    "FloorNumbers": {"albedo", "roughness", "metallic", "specular", "grain", "tint"},
    "LampNumbers": {"power"},
    "MeshBody": {"strength"},
    "Pair": {"mu", "static", "kinetic"},
    "Parameter": {"low", "high", "values"},  # their unit is data
    "Plane": {"normal"},
    "Scene": {"default_friction"},
    "Spin": {"axis"},
    "Stretched": {"strain"},
}
"""The only numbers of a scene without a unit."""


def changed(place: str, value: Any) -> dict[str, Any]:
    """Return the scene with another value at a place."""
    scene = deepcopy(SCENE)
    above, _, last = place.rpartition(".")
    here = at(scene, above)
    if value is GONE:
        del here[last]
    else:
        here[int(last) if isinstance(here, list) else last] = value
    return scene


def at(document: Any, place: str) -> Any:
    """Return what stands at a place: keys and positions, with points between."""
    for step in filter(None, place.split(".")):
        document = document[int(step)] if isinstance(document, list) else document[step]
    return document


def test_the_scene_itself_is_right() -> None:
    scene = Scene.model_validate(SCENE)
    assert list(scene.sheets) == ["lower", "towel", "upper"]
    assert Scene.model_validate_json(scene.model_dump_json()) == scene


def test_every_number_has_a_unit_but_those_that_are_pure() -> None:
    schema = Scene.model_json_schema()
    models = {**schema["$defs"], "Scene": schema}
    pure = {
        name: {
            field
            for field, description in model.get("properties", {}).items()
            if '"number"' in json.dumps(description)
            and not re.search(r"\[.+\]", description.get("description", ""))
        }
        for name, model in models.items()
    }
    assert {name: fields for name, fields in pure.items() if fields} == PURE


@pytest.mark.parametrize(
    "row", WRONG, ids=lambda row: f"{row[0]}={'missing' if row[1] is GONE else row[1]}"[:60]
)
def test_a_wrong_scene_is_refused(row: tuple[Any, ...]) -> None:
    place, value, pointer, rule, *values = row
    document = changed(place, value)
    with pytest.raises(ValidationError) as caught:
        Scene.model_validate(document)
    errors = field_errors(caught.value, document, Scene)
    error_there = {error.pointer: error for error in errors}.get(
        "/" + (pointer or place).replace(".", "/")
    )
    assert error_there, errors
    assert rule in error_there.rule
    if "required" not in rule:
        values = values or [json.dumps(at(document, pointer or place))]
    assert (
        error_there.value == (values[0] if len(values[0]) <= 200 else f"{values[0][:197]}...")
        if values
        else not error_there.value
    )
