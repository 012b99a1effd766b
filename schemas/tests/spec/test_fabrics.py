"""Cards of fabrics: their rules, units, statistics, and keys that follow numbers and not names."""

import math
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from stickslip_schemas.documents.problems import FieldError, field_errors
from stickslip_schemas.kinds import AnyJobSpec, job_spec_adapter
from stickslip_schemas.kinds.cloth_drag import ClothDragSpec
from stickslip_schemas.kinds.cloth_scene import ClothSceneSimulation, ClothSceneSpec
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.points import keyed_points
from stickslip_schemas.spec import fabrics, measured
from stickslip_schemas.spec.fabrics import FabricNumbers
from stickslip_schemas.spec.reality import measured_fabrics

BUILDS = Builds(sim_core="9" * 64, simulate="a" * 64, render="b" * 64, pack="c" * 64)
CARD = {"density": 0.2, "stretching": "gray-interlock", "bending": [1e-5, 2e-5, 4e-6]}
DRAWN = {"distribution": "measured-618", "num": 12, "seed": 5}


def document(material: Any, **more: Any) -> dict[str, Any]:
    axes = {"material": material, "mu": [0.3, 0.6], "texture": "dots", "viewpoint": "left"}
    return {"kind": "cloth_drag", "axes": axes, **more}


def drag(material: Any, **more: Any) -> ClothDragSpec:
    spec = job_spec_adapter.validate_python(document(material, **more))
    assert isinstance(spec, ClothDragSpec)
    return spec


def in_scene(axis: Any, materials: dict[str, Any]) -> ClothSceneSpec:
    scene = {
        "format": "stickslip-scene/1",
        "duration": 0.1,
        "default_friction": 0.3,
        "materials": materials,
        "sheets": {"cloth": {"material": "gray-interlock", "mesh": GRID, "origin": [0, 0, 0.1]}},
        "bodies": {"floor": {"type": "plane"}},
        "parameters": {"fabric": {"sets": ["sheets.cloth.material"]}},
    }
    axes = {"fabric": axis, "texture": "dots", "viewpoint": "front"}
    spec = job_spec_adapter.validate_python(
        {"kind": "cloth_scene", "scene": scene, "axes": axes, "frames": 1}
    )
    assert isinstance(spec, ClothSceneSpec)
    return spec


GRID = {"type": "grid", "size": [0.2, 0.2], "cells": [10, 10]}


def errors(wrong: dict[str, Any]) -> list[FieldError]:
    with pytest.raises(ValidationError) as caught:
        job_spec_adapter.validate_python(wrong)
    return field_errors(caught.value, wrong, AnyJobSpec)


@pytest.mark.parametrize(
    ("changes", "pointer", "rule"),
    [
        ({"bending": [0.0, 1e-5, 1e-6]}, "/bending/0", "[N m]"),
        ({"bending": [1e-5, -1e-5, 1e-6]}, "/bending/1", "[N m]"),
        ({"bending": [0.0173, 0.0134, 0.005]}, "/bending", "is it in mN m"),
        ({"bending": [17.3, 13.4, 5.0]}, "/bending", "is it in uN m"),
        ({"bending": [1e-5, 0.0134, 5e-6]}, "/bending", "0.0134 N m along the weft"),
        ({"bending": [1e-3, 1e-5, 5e-6]}, "/bending", "must have one unit"),
        (
            {"bending": {"warp": 10, "weft": 9, "diagonal": 9, "unit": "mN m"}},
            "/bending",
            "10 mN m along the warp",
        ),
        (
            {"bending": {"warp": 0, "weft": 9, "diagonal": 9, "unit": "uN m"}},
            "/bending/warp",
            "greater than 0",
        ),
        ({"bending": {"warp": 10, "weft": 9, "diagonal": 9}}, "/bending/unit", "required"),
        ({"softening": -300.0}, "/softening", "a negative b softens"),
        ({"softening": 3.0}, "/softening", "is it in 1/cm?"),
        ({"softening": 0.3}, "/softening", "is it in 1/mm?"),
        ({"softening": float("nan")}, "/softening", "finite number"),
        ({"softening": "soft"}, "/softening", "valid number"),
        ({"stretching": "gray-interlok"}, "/stretching", "did you mean gray-interlock"),
        ({"bending": None}, "", "bending must be given"),
    ],
)
def test_a_wrong_card_is_refused_with_field_rule_and_unit(
    changes: dict[str, Any], pointer: str, rule: str
) -> None:
    (error,) = errors(document("own", materials={"own": CARD | changes}))
    assert error.pointer == f"/materials/own{pointer}"
    assert rule in error.rule


def test_one_rigidity_in_each_unit_is_one_card() -> None:
    cards = []
    for unit, scale in fabrics.UNITS.items():
        bending = {"warp": 1e-5 / scale, "weft": 2e-5 / scale, "diagonal": 1.5e-5 / scale}
        cards.append(FabricNumbers.model_validate(CARD | {"bending": bending | {"unit": unit}}))
    # A quarter of the other two comes off the diagonal: the rest is the twist.
    assert {card.bending for card in cards} == {(1e-5, 2e-5, 7.5e-6)}
    assert {card.identity for card in cards} == {cards[0].identity}


def test_drawn_fabrics_have_the_statistics_of_the_measured_ones() -> None:
    cards = drag({"distribution": "measured-618", "num": 2000}).materials.values()
    rows = [[card.density, *(card.bending or ())[:2]] for card in cards]
    logarithms = np.log10(rows)
    np.testing.assert_allclose(logarithms.mean(axis=0), measured.MEASURED_MEAN[:3], atol=0.04)
    np.testing.assert_allclose(logarithms.std(axis=0), measured.MEASURED_DEVIATION[:3], atol=0.03)
    correlations = np.array(measured.MEASURED_CORRELATION)[:3, :3]
    np.testing.assert_allclose(np.corrcoef(logarithms.T), correlations, atol=0.04)


def test_drawn_fabrics_soften_as_the_measured_ones() -> None:
    cards = drag({"distribution": "measured-618", "num": 2000}).materials.values()
    softening = [card.softening or np.nan for card in cards]
    for share, value in measured.SOFTENING_QUANTILES:
        assert np.quantile(softening, share) == pytest.approx(value, rel=0.06)
    assert np.min(softening) > 160.0
    assert np.max(softening) < 1090.0


def test_ranges_draw_softening_only_if_they_say_so() -> None:
    ranges = {"density": [0.1, 0.3], "unit": "uN m"}
    ranges |= {name: [5.0, 20.0] for name in ("warp", "weft", "diagonal")}
    plain = drag({"distribution": ranges, "num": 5}).materials.values()
    soft = drag({"distribution": ranges | {"softening": [200.0, 400.0]}, "num": 5})
    assert {card.softening for card in plain} == {None}
    assert all(200.0 <= (card.softening or 0.0) <= 400.0 for card in soft.materials.values())
    assert [card.density for card in soft.materials.values()] == [card.density for card in plain]


def test_more_draws_keep_the_first_ones() -> None:
    few = drag(DRAWN)
    many = drag(DRAWN | {"num": 20})
    assert list(many.materials.items())[:12] == list(few.materials.items())
    assert (
        drag(DRAWN | {"seed": 6}).materials["measured-618-6-0"].density
        != next(iter(few.materials.values())).density
    )


def test_a_drawn_spec_reads_back_as_itself() -> None:
    spec = drag(DRAWN)
    assert job_spec_adapter.validate_json(spec.model_dump_json()) == spec
    assert spec.sample_count == 24


def test_ranges_of_the_user_bound_every_draw() -> None:
    ranges = {
        "density": [0.1, 0.2],
        "warp": [5, 20],
        "weft": [6, 7],
        "diagonal": [5, 20],
        "unit": "uN m",
    }
    for card in drag({"distribution": ranges, "num": 50}).materials.values():
        assert card.bending is not None
        assert 0.1 <= card.density <= 0.2
        assert 5e-6 <= card.bending[0] <= 2e-5
        assert 6e-6 <= card.bending[1] <= 7e-6


@pytest.mark.parametrize(
    ("changes", "pointer", "rule"),
    [
        ({"distribution": "measured-619"}, "/distribution", "did you mean measured-618"),
        ({"num": 0}, "/num", "greater than or equal to 1"),
        ({"num": 100_000}, "/num", "less than or equal to 2000"),
        ({"num": "12"}, "/num", "integer"),
        (
            {
                "distribution": {
                    "density": [0.1, 0.2],
                    "warp": [5, 20],
                    "weft": [5, 20],
                    "diagonal": [5, 20],
                    "unit": "N m",
                }
            },
            "/distribution",
            "is the unit right?",
        ),
    ],
)
def test_a_wrong_distribution_is_refused(changes: dict[str, Any], pointer: str, rule: str) -> None:
    (error,) = errors(document(DRAWN | changes))
    assert error.pointer == f"/axes/material{pointer}"
    assert rule in error.rule


def test_keys_follow_the_numbers_of_a_card_and_not_its_name_or_source() -> None:
    def keys(name: str, card: dict[str, Any]) -> list[tuple[str, int]]:
        spec = drag(name, materials={name: card})
        return [(point.key, point.split) for point in keyed_points(spec, BUILDS)]

    assert keys("linen", CARD) == keys("canvas", CARD | {"source": "by hand"})
    assert keys("linen", CARD) != keys("linen", CARD | {"density": 0.21})


def test_keys_of_a_scene_follow_the_numbers_of_the_fabrics_that_are_there() -> None:
    def keys(name: str, materials: dict[str, Any]) -> list[str]:
        points = keyed_points(in_scene([name, "camel-ponte-roma"], materials), BUILDS)
        return [point.simulation_key for point in points]

    first = keys("linen", {"linen": CARD})
    assert first == keys("canvas", {"canvas": CARD | {"source": "by hand"}, "other": CARD})
    assert first != keys("linen", {"linen": CARD | {"density": 0.21}})


def test_a_simulation_of_a_scene_has_the_card_of_each_sample() -> None:
    spec = in_scene(DRAWN, {})
    points = list(keyed_points(spec, BUILDS))
    assert len({point.simulation_key for point in points}) == 12
    for point in points:
        card = spec.stage.materials[point.labels["fabric"]]
        assert card is not None
        simulation = spec.simulation_type.model_validate_json(point.simulation_text)
        assert isinstance(simulation, ClothSceneSimulation)
        slotted = simulation.scene.materials[simulation.scene.sheets["cloth"].material]
        assert slotted is not None
        assert slotted.numbers() == card.numbers()
        assert spec.simulation(point.labels) == simulation


def test_the_table_of_built_in_fabrics_agrees_with_its_own_numbers() -> None:
    for facts in measured_fabrics().values():
        for rigidity, length in zip(facts.bending, facts.bending_length, strict=False):
            computed = 1e3 * fabrics.bending_length(rigidity, facts.density)
            assert math.isclose(computed, length, abs_tol=0.06)
