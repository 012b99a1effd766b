"""The kind of scenes: parameters as axes, documents, keys, and what is refused."""

import time
from typing import Any

import pytest
from pydantic import ValidationError
from stickslip_schemas.base import canonical_json
from stickslip_schemas.documents.problems import field_errors
from stickslip_schemas.documents.tasks import RenderTask, SimulateTask, input_digests
from stickslip_schemas.format.manifest import layout
from stickslip_schemas.kinds import AnyJobSpec, job_spec_adapter
from stickslip_schemas.kinds.cloth_scene import ClothSceneSpec
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.costs import count
from stickslip_schemas.plan.points import KeyedPoint, keyed_points

BUILDS = Builds(sim_core="0" * 64, simulate="1" * 64, render="2" * 64, pack="3" * 64)
MESH, PICTURE = f"sha256:{'a' * 64}", f"sha256:{'b' * 64}"
SCENE: dict[str, Any] = {
    "format": "stickslip-scene/1",
    "duration": 2.0,
    "frame_rate": 10,
    "parameters": {
        "mu": {"low": 0, "high": 2, "sets": ["friction.ball.cloth", "friction.cloth.floor"]},
        "fabric": {"sets": ["sheets.cloth.material"]},
        "late": {
            "unit": "s",
            "low": 0.6,
            "high": 1.9,
            "sets": ["sheets.cloth.holders.hand.motion.keys.1.time"],
        },
        "early": {
            "unit": "s",
            "low": 0,
            "high": 0.9,
            "sets": ["sheets.cloth.holders.hand.motion.keys.0.time"],
        },
    },
    "sheets": {
        "cloth": {
            "material": "gray-interlock",
            "mesh": {"type": "grid", "size": [0.2, 0.1], "cells": [8, 4]},
            "holders": {
                "hand": {"edge": "left", "motion": {"keys": [{"time": 0.5}, {"time": 1.0}]}}
            },
        },
        "under": {
            "material": "gray-interlock",
            "mesh": {"type": "grid", "size": [0.2, 0.1], "cells": [8, 4]},
        },
    },
    "bodies": {
        "floor": {"type": "plane"},
        "ball": {"type": "sphere", "radius": 0.1, "origin": [0, 0, 1]},
        "figure": {"type": "mesh", "file": MESH},
    },
    "friction": [
        {"between": ["cloth", "ball"], "mu": 0.3},
        {"between": ["cloth", "floor"], "mu": 0.3},
    ],
    "default_friction": 0.4,
    "looks": {"sheets": {"under": {"texture": PICTURE}}},
}


def document(**change: Any) -> dict[str, Any]:
    """Return a spec; `scene` and `axes` change some keys of theirs."""
    axes = {
        "mu": [0.2, 0.4],
        "texture": ["checker", "plaid"],
        "viewpoint": "front",
        **change.pop("axes", {}),
    }
    scene = {**SCENE, **change.pop("scene", {})}
    return {"kind": "cloth_scene", "scene": scene, "frames": 5, "axes": axes, **change}


def spec_of(**change: Any) -> ClothSceneSpec:
    """Return such a spec, validated."""
    spec = job_spec_adapter.validate_python(document(**change))
    assert isinstance(spec, ClothSceneSpec)
    return spec


def points(**change: Any) -> list[KeyedPoint]:
    """Return the samples of such a spec."""
    return list(keyed_points(spec_of(**change), BUILDS))


def test_documents_have_the_values_of_parameters_at_all_their_places() -> None:
    spec = spec_of(
        axes={
            "fabric": ["gray-interlock", "camel-ponte-roma"],
            "late": {"type": "sobol", "low": 0.6, "high": 1, "num": 2},
        }
    )
    points = list(keyed_points(spec, BUILDS))
    assert len(points) == count(spec).sample_count == 16
    assert len({point.simulation_key for point in points}) == count(spec).simulation_count == 8
    for point in points:
        simulation = spec.simulation(point.labels)
        assert canonical_json(simulation.model_dump(mode="json")) == point.simulation_text
        render = spec.render(point.labels)
        assert render is not None
        assert canonical_json(render.model_dump(mode="json")) == point.render_text
        physics = simulation.scene  # type: ignore[attr-defined]
        assert {pair.mu for pair in physics.friction} == {point.labels["mu"]}
        assert physics.sheets["cloth"].material == point.labels["fabric"]
        assert physics.sheets["cloth"].holders["hand"].motion.keys[1].time == point.labels["late"]


def test_a_parameter_without_an_axis_is_a_label_with_its_default() -> None:
    (first, *_) = points()
    assert (first.labels["fabric"], first.labels["late"]) == ("gray-interlock", 1.0)
    names = [array.name for array in layout(spec_of())]
    assert {
        "mu",
        "fabric",
        "late",
        "cloth.positions",
        "under.contact",
        "holder_force",
        "camera",
    } <= set(names)
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    "change",
    [
        {"scene": {"looks": {"sheets": {"under": {"texture": "dots"}}}}},
        {
            "scene": {
                "looks": {
                    **SCENE["looks"],
                    "cameras": {"front": {"position": [1, 0, 1], "target": [0, 0, 0]}},
                }
            }
        },
        {"scene": {"name": "else", "description": "of something"}},
        {"quality": "draft"},
        {"frames": 4},
    ],
)
def test_what_is_only_seen_or_said_is_in_no_key_of_a_simulation(change: dict[str, Any]) -> None:
    before, after = points(), points(**change)
    assert {p.simulation_key for p in before} == {p.simulation_key for p in after}


@pytest.mark.parametrize(
    "change",
    [
        {"set": {"sheets.cloth.mesh.cells.0": 9}},
        {"set": {"bodies.figure.file": f"sha256:{'c' * 64}"}},
        {"set": {"bias": {"size": 0.001, "until": 1.0}}},
        {"scene": {"gravity": [0, 0, -1.62]}},
    ],
)
def test_what_is_simulated_is_in_the_key(change: dict[str, Any]) -> None:
    before, after = points(), points(**change)
    assert not {p.simulation_key for p in before} & {p.simulation_key for p in after}


def test_tasks_name_the_files_that_they_read() -> None:
    spec = spec_of()
    assert spec.artifacts == {
        "/scene/bodies/figure/file": "a" * 64,
        "/scene/looks/sheets/under/texture": "b" * 64,
    }
    (first, *_) = points()
    assert input_digests(SimulateTask(simulation=spec.simulation(first.labels)), lambda _: b"") == (
        "a" * 64,
    )
    task = {"render": spec.render(first.labels), "record": {"digest": "d" * 64, "row": 0}}
    assert set(input_digests(RenderTask.model_validate(task), lambda _: b"")) == {
        "d" * 64,
        "a" * 64,
        "b" * 64,
    } - {"a" * 64}


def test_a_built_in_scene_is_named() -> None:
    spec = job_spec_adapter.validate_python(document() | {"scene": "turning-ball"})
    assert isinstance(spec, ClothSceneSpec)
    assert spec.scene.name == "turning-ball"
    assert (
        job_spec_adapter.validate_json(spec.model_dump_json()).content_digest == spec.content_digest
    )


@pytest.mark.parametrize(
    ("change", "pointer", "rule", "value"),
    [
        ({"axes": {"nu": 0.3}}, "/axes/nu", "must be one of early, fabric, late, mu", '"nu"'),
        ({"axes": {"mu": [0.3, 3.0]}}, "/axes/mu/1", "must be within 0 to 2", "3.0"),
        ({"axes": {"late": [0.7, 3.0]}}, "/axes/late/1", "must be within 0.6 to 1.9 [s]", "3.0"),
        (
            {
                "axes": {
                    "early": [0.1, 0.8],
                    "late": {"type": "random", "low": 0.7, "high": 1, "num": 3},
                }
            },
            "/axes",
            "keys must ascend in time, and 0.7 s comes after 0.8 s",
            '{"early": 0.8, "late": 0.7}',
        ),
        (
            {"axes": {"fabric": "silk"}},
            "/axes",
            "must be one of 11oz-black-denim",
            '{"fabric": "silk"}',
        ),
        ({"axes": {"mu": "high"}}, "/axes/mu", "must be within 0 to 2", '"high"'),
        ({"axes": {"viewpoint": "left"}}, "/axes/viewpoint", "one of front, side, high", '"left"'),
        (
            {"set": {"sheets.cloth.mesh.cels": 3}},
            "/set/sheets.cloth.mesh.cels",
            "did you mean cells",
            '"sheets.cloth.mesh.cels"',
        ),
        (
            {"set": {"duration": -1.0}},
            "/set/duration",
            "sets duration: must be greater than 0 [s]",
            "-1.0",
        ),
        ({"frames": 22}, "", "frames must be at most 21, the instants of the motion; got 22", ""),
        ({"mesh": 21}, "/mesh", "there is no such field", "21"),
        ({"scene": "turning-bal"}, "/scene", "did you mean turning-ball", '"turning-bal"'),
    ],
)
def test_a_wrong_spec_is_refused(
    change: dict[str, Any], pointer: str, rule: str, value: str
) -> None:
    spec = document(**{key: value for key, value in change.items() if key != "scene"})
    spec |= {key: value for key, value in change.items() if key == "scene"}
    with pytest.raises(ValidationError) as caught:
        job_spec_adapter.validate_python(spec)
    errors = {error.pointer: error for error in field_errors(caught.value, spec, AnyJobSpec)}
    assert rule in errors[pointer].rule
    assert errors[pointer].value == value or not pointer


def test_many_samples_are_planned_without_validating_each() -> None:
    spec = spec_of(axes={"mu": {"type": "random", "low": 0.1, "high": 1, "num": 5000}})
    begin = time.process_time()
    assert sum(1 for _ in keyed_points(spec, BUILDS)) == 10_000
    assert time.process_time() - begin < 5.0  # validation of each document would take 10 s
