"""Scenes that can never work: each is refused with the place, the rule and the value."""

import io
from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from stickslip_schemas.base import replace_at
from stickslip_schemas.scene import sizes, start
from stickslip_schemas.scene.box_trees import Workload
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.errors import UnfitStartError
from stickslip_schemas.scene.files import inlined, with_arrays
from stickslip_schemas.scene.geometry import (
    TriangleMesh,
    find_crossing,
    find_self_crossing,
    find_touch,
)
from stickslip_schemas.scene.library import built_in_files, load_scene, scene_names
from stickslip_schemas.scene.mesh_bodies import moving_meshes
from stickslip_schemas.scene.motions import Track
from stickslip_schemas.scene.reading import reading_files_once
from stickslip_schemas.scene.shapes import box_rounding
from stickslip_schemas.scene.start import check_start, find_start_faults
from stickslip_schemas.spec.jobs import StartFault

SCENE: dict[str, Any] = {
    "format": "stickslip-scene/1",
    "duration": 0.6,
    "preset": "fast",
    "materials": {
        "lining": {"density": 0.08, "young": 2e6, "poisson": 0.3, "thickness": 1.5e-4},
    },
    "sheets": {
        "cloth": {
            "material": "lining",
            "mesh": {"type": "grid", "size": [0.1, 0.1], "cells": [8, 8]},
            "origin": [0.0, 0.0, 0.06],
            "turn": [0.0, 0.0, 0.0],
            "start": {"type": "flat"},
        },
    },
    "bodies": {"floor": {"type": "plane"}},
    "default_friction": 0.4,
    "gravity": [0.0, 0.0, -9.81],
}
OTHER = SCENE["sheets"]["cloth"]
CLOTH = ("sheets", "cloth")
ORIGIN = (*CLOTH, "origin")
SIZE = (*CLOTH, "mesh", "size")
HOLDERS = (*CLOTH, "holders")
BALL = {"type": "sphere", "radius": 0.03, "origin": [0.0, 0.0, 0.05]}


def obj(vertices: Any, triangles: Any, flat: Any = None) -> bytes:
    """Return an OBJ file; `flat` are texture coordinates of the vertices."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    if flat is not None:
        lines += [f"vt {u:.9g} {v:.9g}" for u, v in flat]
    for corners in triangles:
        words = (f"{c + 1}/{c + 1}" if flat is not None else f"{c + 1}" for c in corners)
        lines.append(f"f {' '.join(words)}")
    return "\n".join(lines).encode()


def square(z: float = 0.0) -> tuple[Any, Any]:
    """Return the corners and triangles of a square of 2 m."""
    corners = np.array([[-1, -1, z], [1, -1, z], [1, 1, z], [-1, 1, z]], float)
    return corners, [(0, 1, 2), (0, 2, 3)]


def pattern(shift: float = 0.0) -> tuple[Any, Any]:
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float) * 0.1 + [shift, 0.0]
    return corners, [(0, 1, 2), (0, 2, 3)]


def islands() -> bytes:
    island, triangles = pattern()
    other, _ = pattern(shift=0.2)
    flat = np.vstack([island, other])
    return obj(
        np.column_stack([flat, np.zeros(len(flat))]),
        [*triangles, *[tuple(c + 4 for c in corners) for corners in triangles]],
        flat,
    )


CUBE = 0.02 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
CUBE_TRIANGLES = [
    half
    for a, b, c, d in [
        (0, 1, 3, 2),
        (4, 6, 7, 5),
        (0, 4, 5, 1),
        (2, 3, 7, 6),
        (0, 2, 6, 4),
        (1, 5, 7, 3),
    ]
    for half in ((a, b, c), (a, c, d))
]


def frames(*moves: tuple[float, list[float]]) -> bytes:
    """Return an NPZ file of a cube whose middle is at a place at each time."""
    packed = io.BytesIO()
    np.savez(
        packed,
        positions=np.stack([CUBE + move for _, move in moves]),
        triangles=np.array(CUBE_TRIANGLES),
        times=np.array([time for time, _ in moves]),
    )
    return packed.getvalue()


def skin(height: float) -> bytes:
    """Return an NPZ file of a cube on a bone that rises by a height [m] within 5 ms."""
    bones = np.zeros((3, 1, 3, 4))
    bones[:, 0, :, :3] = np.eye(3)
    bones[2, 0, 2, 3] = height
    packed = io.BytesIO()
    np.savez(
        packed,
        rest=CUBE,
        weights=np.ones((8, 1)),
        bones=bones,
        triangles=np.array(CUBE_TRIANGLES),
        times=np.array([0.0, 0.2, 0.205]),
    )
    return packed.getvalue()


def square_sheet(scale: float) -> bytes:
    """Return a sheet of 0.1 m whose flat pattern is `scale` times as large."""
    flat, triangles = pattern()
    return obj(np.column_stack([flat, np.zeros(len(flat))]), triangles, scale * flat)


FILES = {
    "unit-pattern.obj": square_sheet(10.0),
    "stretched.obj": square_sheet(1 / 1.4),
    "cube.obj": obj(CUBE, CUBE_TRIANGLES),
    "teleport.npz": frames((0, [0, 0, 0.02]), (0.2, [0, 0, 0.02]), (0.201, [0, 0, 0.32])),
    "there-and-back.npz": frames((0, [0, 0, 0.02]), (0.04, [0, 0, 1.02]), (0.08, [0, 0, 0.02])),
    "slow.npz": frames((0, [0, 0, 0.02]), (0.5, [0, 0, 0.035])),
    "late.npz": frames(
        (0, [0, 0, 0.02]), (0.9, [0, 0, 0.02]), (1.0, [0, 0, 0.02]), (1.001, [0, 0, 0.32])
    ),
    "skin.npz": skin(0.4),
    "press.npz": frames((0, [0, 0, 0.1]), (0.4, [0, 0, 0.005]), (0.6, [0, 0, 0.005])),
    "soft-press.npz": frames((0, [0, 0, 0.1]), (0.4, [0, 0, 0.0225]), (0.6, [0, 0, 0.0225])),
    "islands.obj": islands(),
    "plate.obj": obj(*square(0.06)),
    "blade.obj": obj([(-0.02, 0, 0.03), (0.02, 0, 0.03), (0, 0.001, 0.09)], [(0, 1, 2)]),
    "chip.obj": obj(
        [(0.001, 0.001, 0.06), (0.004, 0.001, 0.06), (0.001, 0.004, 0.06)], [(0, 1, 2)]
    ),
}


def keys(*moves: tuple[float, list[float]], **further_keys: Any) -> dict[str, Any]:
    return {"keys": [{"time": time, "move": move} for time, move in moves], **further_keys}


def faults_of(changes: dict[tuple[str, ...], Any]) -> list[StartFault]:
    document: Any = deepcopy(SCENE)
    for location, value in changes.items():
        if location[:-1] == ("sheets", "other"):
            document["sheets"][f"other-{location[-1]}"] = value
        elif location[-1] in ("holders", "other", "ball", "thing"):
            parent = document
            for step in location[:-1]:
                parent = parent[step]
            parent[location[-1]] = value
        else:
            document = replace_at(document, location, value)
    scene, files = inlined(Scene.model_validate(document), FILES.__getitem__)
    return find_start_faults(with_arrays(scene, files.__getitem__))


def file_mesh(name: str) -> dict[str, Any]:
    return {"type": "file", "file": name}


FAULTS: list[tuple[dict[tuple[str, ...], Any], tuple[str, ...], str, Any]] = [
    ({(*CLOTH, "mesh"): file_mesh("islands.obj")}, (*CLOTH, "mesh", "file"), "1 piece", 2),
    (
        {
            SIZE: [9.0, 9.0],
            **{
                ("sheets", "other", str(number)): {
                    **OTHER,
                    "mesh": {"type": "grid", "size": [9.0, 9.0], "cells": [8, 8]},
                    "origin": [0.0, 0.0, 1.0 + number],
                }
                for number in range(2)
            },
        },
        ("sheets",),
        "at most 20 m wide together",
        27.0,
    ),
    ({SIZE: [1e-3, 1e-3]}, SIZE, "higher than the sheet is thick, which is 0.0005 m", 8.84e-5),
    (
        {HOLDERS: {"h": {"low": [0.06, 0.06], "high": [0.08, 0.08]}}},
        (*HOLDERS, "h"),
        "the flat sheet goes from (-0.05, -0.05) to (0.05, 0.05) m",
        {"low": [0.06, 0.06], "high": [0.08, 0.08]},
    ),
    (
        {HOLDERS: {"g": {"edge": "top"}, "h": {"edge": "left"}}},
        (*HOLDERS, "h"),
        "must not hold vertex 72, which another holder holds",
        {"edge": "left"},
    ),
    (
        {HOLDERS: {"h": {"low": [-1, -1], "high": [1, 1]}}},
        HOLDERS,
        "must leave a vertex free",
        ["h"],
    ),
    ({ORIGIN: [0.0, 0.0, -0.01]}, ORIGIN, "vertex 0 of the sheet is 10 mm inside floor", None),
    ({("bodies", "ball"): BALL}, ORIGIN, "vertex 40 of the sheet is 20 mm inside ball", None),
    (
        {("bodies", "ball"): {**BALL, "type": "box", "size": [0.04, 0.04, 0.2], "radius": ...}},
        ORIGIN,
        "vertex 40 of the sheet is 20 mm inside ball",
        None,
    ),
    (
        {("bodies", "ball"): {**BALL, "origin": [0, 0, 1], "motion": keys((0.0, [0, 0, -0.94]))}},
        ORIGIN,
        "vertex 40 of the sheet is 30 mm inside ball",
        None,
    ),
    (
        {("sheets", "other"): {**OTHER, "turn": [1.2, 0, 0]}},
        ("sheets", "other", "origin"),
        "must not cross sheet cloth at the start, and triangle 52 of the sheet crosses triangle 66",
        None,
    ),
    (
        {("sheets", "other"): OTHER},
        ("sheets", "other", "origin"),
        "vertex 0 of the sheet is at 0 m from triangle 0 of it",
        None,
    ),
    (
        {("bodies", "thing"): {"type": "mesh", "file": "blade.obj"}},
        ORIGIN,
        "must not cross body thing at the start, and triangle",
        None,
    ),
    (
        {("bodies", "thing"): {"type": "mesh", "file": "plate.obj"}},
        ORIGIN,
        "must not lie in body thing at the start, and vertex 0 of the sheet is at 0 m",
        None,
    ),
    (
        {("bodies", "thing"): {"type": "mesh", "file": "chip.obj"}},
        ORIGIN,
        "from vertex 0 of it, near (0.001, 0.001, 0.06) m",
        None,
    ),
    (
        {HOLDERS: {"h": {"edge": "left", "motion": keys((0.1, [0, 0, 0]), (0.11, [0, 0, 0.2]))}}},
        (*HOLDERS, "h", "motion"),
        "give it more time, or a ramp",
        None,
    ),
    (
        {
            ("bodies", "ball"): {
                **BALL,
                "origin": [0, 0.3, 0.05],
                "motion": keys((0.1, [0, 0, 0]), (0.105, [0, -0.3, 0]), interpolation="linear"),
            }
        },
        ("bodies", "ball", "motion"),
        "must be one that steps of 0.0078125 s follow to 0.0004 m, as the preset fast asks",
        None,
    ),
    (
        {
            ORIGIN: [0.0, 0.0, 0.002],
            ("bodies", "ball"): {
                "type": "box",
                "size": [0.05, 0.05, 0.024],
                "origin": [0, 0, 0.032],
                "motion": keys((0.1, [0, 0, 0]), (0.4, [0, 0, -0.03])),
            },
        },
        ("bodies", "ball", "motion"),
        "between this body and floor, and at 0.4 s it is 10 mm further than the cloth lets it",
        {"time": 0.4},
    ),
    (
        {
            ORIGIN: [0.0, 0.0, 0.0405],
            ("bodies", "thing"): {"type": "box", "size": [0.2, 0.2, 0.04], "origin": [0, 0, 0.02]},
            ("bodies", "ball"): {
                **BALL,
                "origin": [0, 0, 0.09],
                "motion": keys((0.0, [0, 0, 0]), (0.5, [0, 0, -0.03])),
            },
        },
        ("bodies", "ball", "motion"),
        "must leave room for the cloth between this body and thing",
        {"time": 0.5},
    ),
    (
        {
            HOLDERS: {
                "a": {"edge": "left"},
                "b": {"edge": "right", "motion": keys((0.0, [0, 0, 0]), (0.5, [0.05, 0, 0]))},
            }
        },
        (*HOLDERS, "b", "motion"),
        "at 0.5 s it is 1.5 times as long",
        {"time": 0.5},
    ),
]


LYING: dict[tuple[str, ...], Any] = {ORIGIN: [0.0, 0.0, 0.002]}
THING = ("bodies", "thing")
FAULTS += [
    (
        {THING: {"type": "mesh", "file": "teleport.npz"}},
        ("bodies", "thing", "file"),
        "must have frames that steps of 0.0078125 s follow to 0.0004 m, as the preset fast asks",
        None,
    ),
    (
        {(*CLOTH, "mesh"): file_mesh("unit-pattern.obj"), (*CLOTH, "start"): {"type": "file"}},
        (*CLOTH, "start"),
        "as long as in the flat pattern, and they are 0.1 times as long",
        "file",
    ),
    (
        {THING: {"type": "mesh", "file": "there-and-back.npz"}},
        ("bodies", "thing", "file"),
        "give it more time, with more frames or a lower frame_rate",
        None,
    ),
    (
        {THING: {"type": "mesh", "file": "skin.npz"}},
        ("bodies", "thing", "file"),
        "off an even motion, at a speed of",
        None,
    ),
    (
        {
            HOLDERS: {
                "h": {
                    "edge": "left",
                    "motion": {"keys": [{"time": 0}, {"time": 0.1, "turn": [0, 0, 6.28]}]},
                }
            }
        },
        (*HOLDERS, "h", "motion"),
        "turns are in radians",
        None,
    ),
    (
        {**LYING, THING: {"type": "mesh", "file": "press.npz"}},
        ("bodies", "thing", "file"),
        "between this body and floor, and at 0.4 s it is 15 mm further than the cloth lets it",
        {"time": 0.4},
    ),
    (
        {
            **LYING,
            THING: {
                "type": "mesh",
                "file": "cube.obj",
                "motion": keys((0.0, [0, 0, 0.1]), (0.5, [0, 0, 0.01])),
            },
        },
        ("bodies", "thing", "motion"),
        "between this body and floor, and at 0.5 s it is 10 mm further than the cloth lets it",
        {"time": 0.5},
    ),
    (
        {
            ORIGIN: [0.0, 0.0, 0.062],
            THING: {"type": "mesh", "file": "plate.obj"},
            ("bodies", "ball"): {
                **BALL,
                "origin": [0, 0, 0.1],
                "motion": keys((0.0, [0, 0, 0]), (0.5, [0, 0, -0.03])),
            },
        },
        ("bodies", "ball", "motion"),
        "must leave room for the cloth between this body and thing",
        {"time": 0.5},
    ),
    (
        {
            ORIGIN: [0.0, 0.0, 0.02],
            (*CLOTH, "turn"): [np.pi / 2, 0, 0],
            (*CLOTH, "start"): {"type": "hung"},
            HOLDERS: {"h": {"edge": "top"}},
        },
        ORIGIN,
        "where it hangs, vertex 0 of the sheet is 30 mm inside floor",
        None,
    ),
    (
        # Gravity draws the sheet along y, to the ball.
        {
            ("gravity",): [0.0, 9.81, 0.0],
            ORIGIN: [0.0, 0.0, 0.02],
            (*CLOTH, "start"): {"type": "hung"},
            HOLDERS: {"h": {"edge": "top"}},
            ("bodies", "ball"): {**BALL, "origin": [0.0, 0.1, 0.02]},
        },
        ORIGIN,
        "where it hangs, vertex",
        None,
    ),
    (
        {
            ORIGIN: [0.0, 0.0, 0.12],
            (*CLOTH, "start"): {"type": "hung"},
            HOLDERS: {"h": {"edge": "left"}},
            ("bodies", "ball"): {**BALL, "origin": [-0.05, 0.0, 0.06]},
        },
        ORIGIN,
        "where it hangs, vertex 41 of the sheet is 27.5 mm inside ball",
        None,
    ),
    (
        {
            ORIGIN: [0.0, 0.0, 0.1],
            (*CLOTH, "start"): {"type": "hung"},
            HOLDERS: {"h": {"edge": "left"}},
            THING: {"type": "mesh", "file": "plate.obj"},
        },
        ORIGIN,
        "must not cross body thing where it hangs",
        None,
    ),
]

JAWS: dict[tuple[str, ...], Any] = {
    HOLDERS: {"hand": {"edge": "top"}},
    (*CLOTH, "turn"): [np.pi / 2, 0, 0],
    ORIGIN: [0.0, 0.0, 0.1],
}
"""A curtain in the plane of x and z, held at its upper edge."""


def jaw(side: float, *moves: tuple[float, float]) -> dict[str, Any]:
    """Return a jaw at 20 mm from the curtain, which moves along y by distances at times [m, s]."""
    return {
        "type": "box",
        "size": [0.06, 0.04, 0.06],
        "origin": [0.0, 0.04 * side, 0.1],
        "motion": keys(*((time, [0.0, way, 0.0]) for time, way in moves)),
    }


FAULTS += [
    (
        # Each jaw is 20 mm from the cloth, so they are 6 mm too far together.
        {
            **JAWS,
            ("bodies", "ball"): jaw(-1, (0.1, 0.0), (0.5, 0.023)),
            THING: jaw(1, (0.1, 0.0), (0.5, -0.023)),
        },
        ("bodies", "ball", "motion"),
        "between this body and thing, and at 0.5 s it is 6 mm further than the cloth lets it",
        {"time": 0.5},
    ),
    (
        # They close too far, and then open far.
        {
            **JAWS,
            ("bodies", "ball"): jaw(-1, (0.1, 0.0), (0.3, 0.023), (0.6, -0.1)),
            THING: jaw(1, (0.1, 0.0), (0.3, -0.023), (0.6, 0.1)),
        },
        ("bodies", "ball", "motion"),
        "and at 0.3 s it is 6 mm further",
        {"time": 0.3},
    ),
    (
        {ORIGIN: [0.0, 0.0, 60.0]},
        ORIGIN,
        "the nearest thing is 60 m away, 600 times the size of the sheet; did you mean mm?",
        [0.0, 0.0, 60.0],
    ),
]


def without_placeholders(value: Any) -> Any:
    """Return a body without the fields of the shape that it replaces."""
    if isinstance(value, dict):
        return {key: item for key, item in value.items() if item is not ...}
    return value


@pytest.mark.parametrize(("changes", "location", "rule", "value"), FAULTS)
def test_it_is_refused(
    changes: dict[tuple[str, ...], Any], location: tuple[str, ...], rule: str, value: Any
) -> None:
    faults = faults_of({key: without_placeholders(item) for key, item in changes.items()})
    (fault,) = [fault for fault in faults if fault.location == location]
    assert rule in fault.rule
    if isinstance(value, float):
        assert fault.value == pytest.approx(value, rel=1e-2)
    elif value is not None:
        assert fault.value == value


def test_a_sheet_without_weight_is_not_hung() -> None:
    changes: dict[tuple[str, ...], Any] = {
        ("gravity",): [0.0, 0.0, 0.0],
        (*CLOTH, "start"): {"type": "hung"},
        HOLDERS: {"h": {"edge": "top"}},
    }
    with pytest.raises(ValidationError, match="must not be hung where gravity is zero"):
        faults_of(changes)


CAN_START: list[dict[tuple[str, ...], Any]] = [
    {},
    {ORIGIN: [0.0, 0.0, 0.0]},
    {("sheets", "other"): {**OTHER, "origin": [0, 0, 0.0605]}},
    {("bodies", "ball"): {**BALL, "origin": [0, 0, 0.0295]}},
    {("bodies", "thing"): {"type": "mesh", "file": "plate.obj"}, ORIGIN: [0.0, 0.0, 0.0605]},
    {HOLDERS: {"h": {"edge": "left", "motion": keys((0.1, [0, 0, 0]), (0.4, [0, 0, 0.1]))}}},
    {
        HOLDERS: {
            "a": {"edge": "left"},
            "b": {"edge": "right", "motion": keys((0.0, [0, 0, 0]), (0.5, [0.02, 0, 0]))},
        }
    },
    {
        ORIGIN: [0.0, 0.0, 0.002],
        ("bodies", "ball"): {
            "type": "box",
            "size": [0.05, 0.05, 0.024],
            "origin": [0, 0, 0.032],
            "motion": keys((0.1, [0, 0, 0]), (0.4, [0, 0, -0.0195])),
        },
    },
    {HOLDERS: {"h": {"rim": True}}, ORIGIN: [0.0, 0.0, 0.03]},
    {THING: {"type": "mesh", "file": "slow.npz"}},
    {(*CLOTH, "mesh"): file_mesh("unit-pattern.obj")},
    {(*CLOTH, "mesh"): file_mesh("stretched.obj"), (*CLOTH, "start"): {"type": "file"}},
    {THING: {"type": "mesh", "file": "late.npz"}},
    {**LYING, THING: {"type": "mesh", "file": "soft-press.npz"}},
    # Jaws that leave a millimetre each, or go along with each other.
    {
        **JAWS,
        ("bodies", "ball"): jaw(-1, (0.1, 0.0), (0.5, 0.019)),
        THING: jaw(1, (0.1, 0.0), (0.5, -0.019)),
    },
    {
        **JAWS,
        ("bodies", "ball"): jaw(-1, (0.1, 0.0), (0.5, 0.01)),
        THING: jaw(1, (0.1, 0.0), (0.5, 0.01)),
    },
    # A sheet far up that a hand carries.
    {
        ORIGIN: [0.0, 0.0, 60.0],
        HOLDERS: {"h": {"edge": "left", "motion": keys((0.1, [0, 0, 0]), (0.5, [0, 0, 0.1]))}},
    },
    # Cloth that stands at a wall falls before a press is there.
    {
        (*CLOTH, "turn"): [0, np.pi / 2, 0],
        THING: {
            "type": "mesh",
            "file": "cube.obj",
            "motion": keys((0.0, [0.1, 0, 0.06]), (0.5, [-0.1, 0, 0.06])),
        },
        ("bodies", "ball"): {"type": "plane", "origin": [-0.005, 0, 0], "normal": [1, 0, 0]},
    },
    # How a sheet hangs from a corner, only a simulation tells.
    {
        (*CLOTH, "start"): {"type": "hung"},
        HOLDERS: {"h": {"vertices": [0]}},
        ("bodies", "ball"): {**BALL, "origin": [0.0, 0.0, 0.0]},
    },
    {
        ORIGIN: [0.0, 0.0, 0.12],
        (*CLOTH, "start"): {"type": "hung"},
        HOLDERS: {"h": {"edge": "left"}},
        ("bodies", "ball"): {**BALL, "origin": [0.05, 0.0, 0.06]},
    },
    {
        (*CLOTH, "mesh"): {"type": "unstructured", "size": [0.1, 0.1], "spacing": 0.01},
        HOLDERS: {"a": {"edge": "left"}, "b": {"low": [-0.03, -0.05], "high": [0.03, -0.04]}},
    },
]


@pytest.mark.parametrize("changes", CAN_START)
def test_it_can_start(changes: dict[tuple[str, ...], Any]) -> None:
    assert faults_of(changes) == []


ROD = {"type": "cylinder", "origin": [0.0, 0.0, -1.0], "turn": [1.5708, 0.0, 0.0]}
BOX = {"type": "box", "origin": [0.0, 0.0, -1.0]}
LEAST = 0.9 * 0.1 / 8


@pytest.mark.parametrize(
    ("body", "member", "words"),
    [
        ({**ROD, "radius": 0.99 * LEAST}, "radius", "0.9 cells, which is 0.01125 m"),
        ({**BALL, "radius": 0.99 * LEAST}, "radius", "0.9 cells, which is 0.01125 m"),
        ({**ROD, "type": "capsule", "length": 0.1, "radius": 0.002}, "radius", "0.9 cells"),
        ({**BOX, "size": [1, 1, 1], "rounding": 0.99 * LEAST}, "rounding", "0.9 cells"),
        ({**BOX, "size": [1, 1, 1.98 * LEAST]}, "size", "1.8 cells thick, which is 0.0225 m"),
    ],
)
def test_bodies_are_round_against_a_cell(body: dict[str, Any], member: str, words: str) -> None:
    (fault,) = faults_of({("bodies", "thing"): body})
    assert fault.location == ("bodies", "thing", member)
    assert words in fault.rule
    assert "with the sheet cloth: cells of 0.0125 m catch on what is sharper" in fault.rule
    assert "make it larger, or the sheet finer" in fault.rule
    assert fault.value == (list(body[member]) if member == "size" else body[member])


@pytest.mark.parametrize(
    "body",
    [
        {**ROD, "radius": LEAST},
        {**BOX, "size": [1, 1, 1], "rounding": LEAST},
        {**BOX, "size": [1, 1, 2.02 * LEAST]},
    ],
)
def test_bodies_may_be_as_sharp_as_that(body: dict[str, Any]) -> None:
    assert faults_of({("bodies", "thing"): body}) == []


def test_the_coarsest_sheet_counts() -> None:
    coarse = {**OTHER, "mesh": {"type": "grid", "size": [0.1, 0.1], "cells": [4, 4]}}
    changes = {
        ("sheets", "other", "towel"): {**coarse, "origin": [0.0, 0.0, 0.2]},
        ("bodies", "thing"): {**ROD, "radius": 0.02},
    }
    (fault,) = faults_of(changes)
    assert "which is 0.0225 m with the sheet other-towel" in fault.rule


@pytest.mark.parametrize(
    ("size", "cell", "rounding"),
    [([1, 1, 1], 0.001, 0.005), ([1, 1, 1], 0.01, 0.009), ([1, 1, 0.012], 0.01, 0.006)],
)
def test_the_edges_of_a_box_are_round_by_default(
    size: list[float], cell: float, rounding: float
) -> None:
    assert box_rounding({"size": size, "rounding": None}, cell) == pytest.approx(rounding)
    assert box_rounding({"size": size, "rounding": 0.1}, cell) == 0.1


@pytest.mark.parametrize("name", scene_names())
def test_built_in_scenes_can_start(name: str) -> None:
    assert find_start_faults(with_arrays(load_scene(name), built_in_files().__getitem__)) == []


def test_the_error_names_all_faults() -> None:
    document: Any = replace_at(deepcopy(SCENE), SIZE, [1e-3, 1e-3])
    scene = Scene.model_validate(document)
    with pytest.raises(UnfitStartError, match=r"sheets\.cloth\.mesh\.size: must have triangles"):
        check_start(with_arrays(scene, FILES.__getitem__))


def test_every_pair_of_random_triangles_is_compared() -> None:
    """The trees leave out no crossing: the same answer as all pairs give."""
    rng = np.random.default_rng(5)
    for _ in range(5):
        soup = TriangleMesh(rng.uniform(0, 1, (60, 3)), np.arange(60).reshape(-1, 3))
        other = TriangleMesh(rng.uniform(0.9, 1.6, (60, 3)), np.arange(60).reshape(-1, 3))
        single = [
            find_crossing(
                TriangleMesh(soup.vertices, soup.triangles[i : i + 1]),
                TriangleMesh(other.vertices, other.triangles[j : j + 1]),
                Workload(10_000),
            )
            for i in range(20)
            for j in range(20)
        ]
        assert (find_crossing(soup, other, Workload(10_000)) is None) == all(
            item is None for item in single
        )


def test_touches_are_found_at_faces_edges_and_corners() -> None:
    corners, triangles = square()
    mesh = TriangleMesh(corners, np.array(triangles))
    for point, expected in (
        ((0.2, 0.1, 1e-4), True),
        ((1.0 + 1e-4, 0.0, 0.0), True),
        ((1.0, 1.0, 1e-4), True),
        ((0.2, 0.1, 3e-4), False),
        ((1.0 + 2e-4, 1.0 + 2e-4, 0.0), False),
    ):
        touch = find_touch(
            TriangleMesh(np.array([point]), np.empty((0, 3), np.int64)),
            mesh,
            2e-4,
            Workload(10_000),
        )
        assert (touch is not None) == expected, point


def test_a_fold_crosses_itself_and_a_hinge_does_not() -> None:
    hinge = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]], float)
    assert (
        find_self_crossing(TriangleMesh(hinge, np.array([[0, 1, 2], [1, 3, 2]])), Workload(10_000))
        is None
    )
    through = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, -1], [0.3, 0.2, 1], [0.2, 0.3, 1]], float
    )
    crossing = find_self_crossing(
        TriangleMesh(through, np.arange(6).reshape(2, 3)), Workload(10_000)
    )
    assert crossing is not None
    assert (crossing.first, crossing.second) == (0, 1)


def test_too_many_pairs_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Slanted needles, whose boxes all overlap, would take a check a minute."""
    changes: dict[tuple[str, ...], Any] = {
        THING: {"type": "mesh", "file": "cube.obj"},
        ORIGIN: [0.0, 0.0, 0.01],
    }
    (fault,) = faults_of(changes)
    assert fault.location == ORIGIN
    monkeypatch.setattr(start, "MAX_COMPARED_PAIRS", 20)
    (fault,) = faults_of(changes)
    assert fault.location == ("sheets",)
    assert "at most 20 pairs of boxes around their triangles" in fault.rule


def test_files_are_limited_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """One file may serve many bodies: each of them costs time."""
    bodies: dict[tuple[str, ...], Any] = {}
    for name, x in (("ball", 0.2), ("thing", 0.4)):
        motion = keys((0.0, [x, 0, 0.1]), (0.5, [x, 0, 0.11]))
        bodies["bodies", name] = {"type": "mesh", "file": "cube.obj", "motion": motion}
    assert faults_of(bodies) == []
    monkeypatch.setattr(sizes, "MAX_BODY_TRIANGLES", 23)
    (fault,) = faults_of(bodies)
    assert (fault.location, fault.value) == (("bodies",), 24)
    assert "at most 23 triangles together" in fault.rule


def test_a_path_with_a_key_every_millisecond_is_compared() -> None:
    """Where windows of keys overlap, even samples stand for them: a jump is seen all the same."""
    times = np.linspace(0.0, 10.0, 10_001)
    x = 0.02 * np.sin(times)
    x[7_000:] += 0.05
    motion = {
        "spin": None,
        "about": None,
        "keys": None,
        "path": {"time": times, "move": np.outer(x, [1, 0, 0]), "turn": np.zeros((10_001, 3))},
        "interpolation": "linear",
        "ramp": 0.0,
    }
    time, unevenness = Track(motion).unevenness(0.0078, 0.1, 10.0)
    assert time == pytest.approx(7.0, abs=0.01)
    # The middle of the step is half the jump away from an even motion.
    assert unevenness == pytest.approx(0.025, rel=0.15)


def test_a_linear_motion_with_ramps_is_exact() -> None:
    motion = {
        "spin": None,
        "about": None,
        "path": None,
        "keys": [
            {"time": 1.0, "move": [0, 0, 0], "turn": [0, 0, 0]},
            {"time": 2.0, "move": [0.5, 0, 0], "turn": [0, 0, 0]},
        ],
        "interpolation": "linear",
        "ramp": 0.2,
    }
    x = Track(motion).at(np.array([0.0, 1.1, 1.2, 1.5, 2.0, 2.1, 2.2, 9.0]))[:, 0]
    # Speed 0.5 m/s after a ramp of 0.2 s: v t^2 / (2 r) within it, v (t - r / 2) after it.
    expected = [0.0, 0.0125, 0.05, 0.2, 0.45, 0.4875, 0.5, 0.5]
    assert x == pytest.approx(expected, abs=1e-12)


def test_bodies_of_one_file_share_its_motion_and_stand_at_their_own_places() -> None:
    moved = {"keys": [{"time": 0.0, "move": [0.0, 0.0, 0.5]}]}
    document: Any = deepcopy(SCENE)
    body = {"type": "mesh", "file": "cube.obj"}
    document["bodies"] |= {"still": body, "raised": body | {"motion": moved}}
    scene, files = inlined(Scene.model_validate(document), FILES.__getitem__)
    with reading_files_once():
        meshes = moving_meshes(with_arrays(scene, files.__getitem__))
    assert meshes["still"].frames is meshes["raised"].frames
    shift = meshes["raised"].surface.vertices - meshes["still"].surface.vertices
    assert np.allclose(shift, [0.0, 0.0, 0.5])
