"""Specs: what is taken, and that a bad one is answered with field, rule and value."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import ValidationError
from stickslip_schemas.base import Stage
from stickslip_schemas.documents.problems import FieldError, field_errors
from stickslip_schemas.kinds import AnyJobSpec, job_spec_adapter
from stickslip_schemas.kinds.cloth_drag import SELF_FRICTION, ClothDragSimulation, ClothDragSpec
from stickslip_schemas.kinds.rod_hang import RodHangSpec
from stickslip_schemas.spec.arrays import COMMON_ARRAYS
from stickslip_schemas.spec.jobs import CONTACT_PROTOCOLS

EXAMPLES = Path(__file__).parents[3] / "examples"

RODS: dict[str, Any] = {
    "kind": "rod_hang",
    "axes": {
        "gamma": {"type": "linspace", "start": 100, "stop": 1300, "num": 4},
        "phi0": [0.2, 6],
        "phi1": 12,
    },
}
CLOTH: dict[str, Any] = {
    "kind": "cloth_drag",
    "axes": {
        "material": ["royal-target"],
        "mu": [0.1, 0.2],
        "texture": "dots",
        "viewpoint": ["left"],
    },
}


def changed(document: dict[str, Any], pointer: str, value: Any) -> dict[str, Any]:
    result = copy.deepcopy(document)
    *parents, last = pointer.strip("/").split("/")
    here = result
    for part in parents:
        here = here[part]
    here[last] = value
    return result


def errors_of(document: Any) -> list[FieldError]:
    with pytest.raises(ValidationError) as caught:
        job_spec_adapter.validate_python(document)
    return field_errors(caught.value, document, AnyJobSpec)


def test_a_scene_s_axis_with_a_wrong_name_and_no_type_is_refused_by_fields() -> None:
    axes = {"viewpoint": [0], "x-axis": {"low": 0.0, "high": 0.0, "num": 1}}
    fields = errors_of({"kind": "cloth_scene", "axes": axes})
    assert {field.pointer for field in fields if "x-axis" in field.pointer} == {
        "/axes/x-axis",
        "/axes/x-axis/type",
    }


def test_short_and_long_forms_are_one_spec() -> None:
    short = job_spec_adapter.validate_python(RODS)
    long = job_spec_adapter.validate_python(job_spec_adapter.dump_python(short, mode="json"))
    assert short == long
    assert short.sample_count == 8


@pytest.mark.parametrize(
    ("name", "kind", "count"),
    [
        ("thesis-rods", RodHangSpec, 10_000),
        ("thesis-cloth", ClothDragSpec, 3_840),
        ("demo-rods", RodHangSpec, 48),
        ("demo-cloth", ClothDragSpec, 4),
        ("friction-cloth", ClothDragSpec, 2),
        ("camera-cloth", ClothDragSpec, 4),
        ("sampled-rods", RodHangSpec, 2_500),
    ],
)
def test_examples_are_specs(name: str, kind: type, count: int) -> None:
    spec = job_spec_adapter.validate_python(yaml.safe_load((EXAMPLES / f"{name}.yaml").read_text()))
    assert isinstance(spec, kind)
    assert spec.sample_count == count
    assert spec.name == name


@pytest.mark.parametrize(
    ("document", "pointer", "rule", "value"),
    [
        (
            changed(CLOTH, "/axes/material", ["royal-target", "silk"]),
            "/axes/material/1",
            "white-swim-solid",
            '"silk"',
        ),
        (
            changed(CLOTH, "/axes/mu", [0.1, -0.1]),
            "/axes/mu/1",
            "greater than or equal to 0",
            "-0.1",
        ),
        (changed(CLOTH, "/axes/mu", -0.1), "/axes/mu", "greater than or equal to 0", "-0.1"),
        (
            changed(CLOTH, "/axes/static_ratio", [1.0, 0.9]),
            "/axes/static_ratio/1",
            "greater than or equal to 1",
            "0.9",
        ),
        (
            changed(changed(CLOTH, "/axes/mu", [0.5, 5]), "/axes/static_ratio", [1.5, 2.5]),
            "/axes/static_ratio/1",
            "times the largest mu, 5, must be at most 10",
            "2.5",
        ),
        (changed(CLOTH, "/axes/texture", "velvet"), "/axes/texture", "herringbone", '"velvet"'),
        (changed(CLOTH, "/mesh", 3), "/mesh", "greater than or equal to 5", "3"),
        (changed(RODS, "/axes/gamma", [float("nan")]), "/axes/gamma/0", "finite number", "NaN"),
        (
            changed(RODS, "/axes/gamma", [float("inf")]),
            "/axes/gamma/0",
            "finite number",
            "Infinity",
        ),
        (changed(RODS, "/axes/gamma", ["7"]), "/axes/gamma/0", "valid number", '"7"'),
        (changed(RODS, "/axes/phi0", []), "/axes/phi0", "at least 1 item", "[]"),
        (
            changed(RODS, "/axes/phi0", [1, 2, 1.0]),
            "/axes/phi0",
            "values must differ unless axes are zipped, and 1.0 is there twice",
            "[1.0, 2.0, 1.0]",
        ),
        (
            changed(RODS, "/axes/gamma/num", 10**12),
            "/axes/gamma/num",
            "less than or equal to 1000000",
            str(10**12),
        ),
        (changed(RODS, "/axes/gamma/num", 0), "/axes/gamma/num", "greater than or equal to 1", "0"),
        (changed(RODS, "/axes/gamma/sto", 2), "/axes/gamma/sto", "did you mean stop?", "2"),
        (
            changed(RODS, "/axes/gamma/type", "cubic"),
            "/axes/gamma/type",
            "list, linspace, random, sobol",
            '"cubic"',
        ),
        (
            changed(RODS, "/axes/phi1", {"type": "sobol", "low": 2, "high": 2, "num": 3}),
            "/axes/phi1",
            "low",
            '"low": 2',
        ),
        (changed(RODS, "/poisson", -1), "/poisson", "greater than -1", "-1"),
        (changed(RODS, "/colour", "red"), "/colour", "no such field. Fields: axes", '"red"'),
        (changed(RODS, "/sede", 1), "/sede", "did you mean seed?", "1"),
        (changed(RODS, "/seed", "1"), "/seed", "valid integer", '"1"'),
        (changed(RODS, "/samples_per_shard", True), "/samples_per_shard", "valid integer", "true"),
        (changed(CLOTH, "/frames", 30.5), "/frames", "valid integer", "30.5"),
        (changed(CLOTH, "/quality", "hihg"), "/quality", "did you mean high?", '"hihg"'),
        (
            changed(CLOTH, "/axes/texture", ["dot"]),
            "/axes/texture/0",
            "did you mean dots?",
            '"dot"',
        ),
        (changed(RODS, "/kind", "rod-hang"), "/kind", "did you mean rod_hang?", '"rod-hang"'),
        (
            changed(RODS, "/splits", {"train": 0.5, "validation": 0, "test": 0}),
            "/splits",
            "add up to 0.5",
            "0.5",
        ),
        (changed(RODS, "/combine", "zip"), "", "one length", '"kind": "rod_hang"'),
        ({"kind": "rod_hang", "axes": {"gamma": 1, "phi0": 1}}, "/axes/phi1", "required", ""),
        ([], "", "must be an object", "[]"),
    ],
)
def test_bad_specs_are_pointed_at(document: Any, pointer: str, rule: str, value: str) -> None:
    (error,) = errors_of(document)
    assert error.pointer == pointer
    assert rule in error.rule
    assert value in error.value


POINT = {"material": "royal-target", "mu": 0.1, "texture": "dots", "viewpoint": "left"}


@pytest.mark.parametrize(
    ("fields", "meant"), [({}, SELF_FRICTION), ({"self_friction": None}, None)]
)
def test_dragged_cloth_has_self_contact_unless_its_spec_says_null(
    fields: dict[str, Any], meant: float | None
) -> None:
    spec = job_spec_adapter.validate_python(CLOTH | fields)
    simulation = spec.simulation(POINT)
    assert isinstance(simulation, ClothDragSimulation)
    assert simulation.self_friction == meant
    assert spec.certified_protocols == (() if meant is None else CONTACT_PROTOCOLS)
    assert ("self-contact" in spec.cost_group(Stage.simulate, POINT)) == (meant is not None)
    assert "self-contact" not in spec.cost_group(Stage.render, POINT)


@pytest.mark.parametrize("document", [None, 3, {}, {"kind": []}, {"kind": "silk_fly"}])
def test_a_document_of_no_kind_is_refused(document: Any) -> None:
    with pytest.raises(ValidationError):
        job_spec_adapter.validate_python(document)


def test_too_many_points_in_all_are_refused_without_being_made() -> None:
    axis = {"type": "linspace", "start": 0, "stop": 1, "num": 10_000}
    (error,) = errors_of({"kind": "rod_hang", "axes": {"gamma": axis, "phi0": axis, "phi1": axis}})
    assert "at most 1000000 samples" in error.rule
    assert "1000000000000" in error.rule


def test_every_problem_is_told_at_once() -> None:
    document = changed(changed(RODS, "/axes/gamma", -1), "/poisson", 2)
    assert {error.pointer for error in errors_of(document)} == {"/axes/gamma", "/poisson"}


def test_long_values_are_cut_and_errors_are_json() -> None:
    (error,) = errors_of(changed(RODS, "/axes/gamma", {"type": "list", "values": ["x" * 10_000]}))
    assert len(error.value) == 200
    json.loads(error.model_dump_json())


def test_schema_names_the_quantities() -> None:
    definitions = job_spec_adapter.json_schema()["$defs"]
    assert {"RodHangSpec", "ClothDragSpec", "RodHangAxes", "ClothDragAxes"} <= set(definitions)


def test_no_two_arrays_have_one_name() -> None:
    truth = ["depth", "segmentation", "normals", "uv", "flow"]
    looks = {"texture": ["plaid"], "viewpoint": ["front"]}
    specs = [RODS, changed(CLOTH, "/ground_truth", truth)]
    specs.append(
        {"kind": "cloth_scene", "scene": "turning-ball", "axes": looks, "ground_truth": truth}
    )
    for document in specs:
        spec = job_spec_adapter.validate_python(document)
        names = [array.name for array in (*spec.arrays(), *COMMON_ARRAYS)]
        assert len(set(names)) == len(names)
