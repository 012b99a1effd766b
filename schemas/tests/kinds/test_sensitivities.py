"""Derivatives that a spec asks for: which parameters may be asked for, arrays and keys."""

from typing import Any

import pytest
from pydantic import ValidationError
from stickslip_schemas.documents.problems import field_errors
from stickslip_schemas.format.manifest import layout
from stickslip_schemas.kinds import AnyJobSpec, job_spec_adapter
from stickslip_schemas.spec.jobs import JobSpec

DRAG: dict[str, Any] = {
    "kind": "cloth_drag",
    "mesh": 11,
    "axes": {
        "material": "gray-interlock",
        "mu": [0.2, 0.5],
        "texture": "checker",
        "viewpoint": "calibrated",
    },
}

SHEET: dict[str, Any] = {
    "material": "gray-interlock",
    "mesh": {"type": "grid", "size": [0.2, 0.1], "cells": [8, 4]},
    "origin": [0, 0, 0.2],
    "holders": {"hand": {"edge": "left", "motion": {"keys": [{"time": 0.0}, {"time": 1.0}]}}},
}

SCENE: dict[str, Any] = {
    "format": "stickslip-scene/1",
    "duration": 1.0,
    "frame_rate": 10,
    "parameters": {
        "mu": {"low": 0, "high": 2, "sets": ["friction.cloth.floor"]},
        "lift": {
            "unit": "m",
            "low": 0,
            "high": 0.5,
            "sets": ["sheets.cloth.holders.hand.motion.keys.1.move.2"],
        },
        "radius": {"unit": "m", "low": 0.05, "high": 0.2, "sets": ["bodies.ball.radius"]},
        "fabric": {"sets": ["sheets.cloth.material"]},
    },
    "sheets": {"cloth": SHEET},
    "bodies": {
        "floor": {"type": "plane"},
        "ball": {"type": "sphere", "radius": 0.1, "origin": [1, 0, 0.1]},
    },
    "friction": [{"between": ["cloth", "floor"], "mu": 0.3}],
    "default_friction": 0.3,
}

SPEC: dict[str, Any] = {
    "kind": "cloth_scene",
    "scene": SCENE,
    "frames": 5,
    "axes": {"texture": "checker", "viewpoint": "front"},
}


def parsed(document: dict[str, Any], **more: Any) -> JobSpec:
    return job_spec_adapter.validate_python({**document, **more})


def refusal(document: dict[str, Any], **more: Any) -> tuple[str, str]:
    """Return the pointer and the rule of the only error of a spec."""
    whole = {**document, **more}
    with pytest.raises(ValidationError) as caught:
        job_spec_adapter.validate_python(whole)
    (error,) = field_errors(caught.value, whole, AnyJobSpec)
    return error.pointer, error.rule


@pytest.mark.parametrize(
    ("document", "names", "pointer", "rule"),
    [
        (DRAG, ["my"], "/sensitivities/0", "must be one of mu, density, bending, stretching"),
        (DRAG, ["material"], "/sensitivities/0", "material is a name"),
        (DRAG, ["mu", "mu"], "/sensitivities/1", "must be named once"),
        (SPEC, ["bending"], "/sensitivities/0", "must be one of lift, mu"),
        (SPEC, ["radius"], "/sensitivities/0", "radius sets bodies.ball.radius, which decides"),
        (SPEC, ["fabric"], "/sensitivities/0", "fabric is a name"),
    ],
)
def test_what_has_no_derivative_is_refused(
    document: dict[str, Any], names: list[str], pointer: str, rule: str
) -> None:
    where, message = refusal(document, sensitivities=names)
    assert where == pointer
    assert rule in message


def test_derivatives_need_positions() -> None:
    where, rule = refusal(DRAG, sensitivities=["mu"], store_positions=False)
    assert where == "/sensitivities"
    assert "must be empty if store_positions is false" in rule


@pytest.mark.parametrize(("document", "prefix"), [(DRAG, ""), (SPEC, "cloth.")])
def test_derivatives_have_the_shape_of_positions(document: dict[str, Any], prefix: str) -> None:
    arrays = {array.name: array for array in layout(parsed(document, sensitivities=["mu"]))}
    by_mu, positions = arrays[f"{prefix}positions_by_mu"], arrays[f"{prefix}positions"]
    assert (by_mu.shape, by_mu.dimensions) == (positions.shape, positions.dimensions)
    assert by_mu.attributes["unit"] == "m per 1"
    assert arrays["one_sided_by_mu"].shape == positions.shape[:1]
    assert arrays["largest_by_mu"].is_label


@pytest.mark.parametrize("document", [DRAG, SPEC])
def test_a_spec_without_derivatives_keeps_its_keys(document: dict[str, Any]) -> None:
    plain, empty = parsed(document), parsed(document, sensitivities=[])
    asked = parsed(document, sensitivities=["mu"])
    assert "sensitivities" not in plain.model_dump(mode="json")
    assert plain.content_digest == empty.content_digest != asked.content_digest
    point = next(iter(plain.grid()))
    simulations = [spec.simulation(point).model_dump(mode="json") for spec in (plain, asked)]
    assert "sensitivities" not in simulations[0]
    assert list(simulations[1]["sensitivities"]) == ["mu"]


def test_derivatives_cost() -> None:
    seconds = [parsed(DRAG, sensitivities=names).default_costs.simulate for names in ([], ["mu"])]
    assert seconds[1] == pytest.approx(1.5 * seconds[0])
