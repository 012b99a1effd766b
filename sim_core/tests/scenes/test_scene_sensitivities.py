"""Derivatives of scenes by their parameters, against differences of runs with equal steps."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.fabrics import Fabric, fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.scenes import cloth_drag, cloth_scene
from stickslip_sim_core.scenes.cloth_scene import FamilyParameter
from stickslip_sim_core.scenes.family import SceneFamily, SceneParameter, UnfitParameterError
from stickslip_sim_core.scenes.scene import Scene

pytestmark = pytest.mark.physics

FIXED = replace(preset_named("certified"), step_error=None, tolerance=1e-8, second_order=False)
"""Equal steps for all runs: a controller would choose others for another parameter. Of second order
a run would jump where a vertex lands or leaves.
"""


def with_fixed_steps(family: SceneFamily, step: float) -> SceneFamily:
    preset = replace(FIXED, time_step=step)

    def make(values: Mapping[str, float], hang: Any) -> Scene:
        return replace(family.make(values, hang), preset=preset)

    return replace(family, make=make)


def relative_error(family: SceneFamily, name: str, change: float, frames: slice) -> float:
    """Return the error of derivatives against central differences at frames."""
    run = family.differentiated([name]).run()
    value = family.parameters[name].value
    high, low = (family.scene(**{name: value + h}).run().positions for h in (change, -change))
    difference = (high - low)[frames] / (2.0 * change)
    by = run.sensitivities[name].positions[frames]
    assert np.abs(by).max() > 0.0
    return float(np.linalg.norm(difference - by) / np.linalg.norm(by))


SOFTENED = replace(fabric("gray-interlock"), softening=300.0)
"""Its bending softens by half at a radius of 7 mm, which folds of a drag have."""


def drag(material: str | Fabric = "gray-interlock", **more: Any) -> SceneFamily:
    return cloth_drag.family(material, 0.3, mesh=11, self_friction=None, **more)


PARTS_OF_BENDING = ["bending_ratio", "bending_twist", "softening"]


@pytest.mark.parametrize("name", ["bending", "density", "stretching", *PARTS_OF_BENDING])
def test_hung_start_is_differentiated(name: str) -> None:
    family = drag(SOFTENED, frames=1)
    (by,) = family.differentiated([name]).sensitivities
    h = 1e-4
    starts = [family.scene(**{name: 1.0 + change}).start for change in (h, -h)]
    difference = (starts[0] - starts[1]) / (2.0 * h)
    # The start is at rest up to rounding, which the difference multiplies: softening moves it by
    # 0.1 mm per unit only.
    largest = np.abs(by.start).max()
    assert np.abs(difference - by.start).max() < 1e-5 * largest + 1e-8


@pytest.mark.parametrize("name", ["mu", "bending", "speed", *PARTS_OF_BENDING])
def test_drag_is_differentiated(name: str) -> None:
    # It comes to the floor, and is dragged. A contact may change its branch within the difference
    # in some frames.
    free = drag(SOFTENED if name in PARTS_OF_BENDING else "gray-interlock", frames=31)
    steps = free.scene().run().step_ends

    def with_steps(values: Mapping[str, float], hang: Any) -> Scene:
        scene = free.make(values, hang)
        return replace(scene, preset=replace(scene.preset, tolerance=1e-8), step_ends=steps)

    family = replace(free, make=with_steps)
    by = family.differentiated([name]).run().sensitivities[name].positions[1:]
    value = family.parameters[name].value
    # Parts of the bending move the cloth less, and digits of positions would show in a difference
    # by a smaller change.
    h = 1e-4 if name in PARTS_OF_BENDING else 1e-5
    high, low = (family.scene(**{name: value + step}).run().positions[1:] for step in (h, -h))
    errors = np.linalg.norm((high - low) / (2.0 * h) - by, axis=(1, 2))
    sizes = np.linalg.norm(by, axis=(1, 2))
    depends = sizes > 1e-6
    assert depends.sum() > 20
    assert np.median(errors[depends] / sizes[depends]) < 2e-5


def test_positions_do_not_change() -> None:
    family = drag(frames=24)
    run = family.differentiated(["mu", "bending"]).run()
    assert np.array_equal(run.positions, family.scene().run().positions)


def test_repeated_steps_are_those_of_the_other_run() -> None:
    family = drag(frames=24)
    run = family.scene().run()
    assert len(run.step_ends) == run.labels["steps"]
    again = replace(family.scene(), step_ends=run.step_ends).run()
    assert np.array_equal(again.step_ends, run.step_ends)
    assert again.positions == pytest.approx(run.positions, abs=1e-6)
    # At another value the step control chooses other steps, unless they are given.
    other = family.scene(mu=0.31)
    assert not np.array_equal(other.run().step_ends, run.step_ends)
    repeated = replace(other, step_ends=run.step_ends).run()
    assert np.array_equal(repeated.step_ends, run.step_ends)
    assert repeated.valid


def test_steps_go_on_after_the_last_repeated_one() -> None:
    family = drag(frames=24)
    run = family.scene().run()
    half = len(run.step_ends) // 2
    again = replace(family.scene(), step_ends=run.step_ends[:half]).run()
    assert np.array_equal(again.step_ends[:half], run.step_ends[:half])
    assert again.valid
    assert len(again.positions) == 24


def test_repeated_steps_end_at_grasps() -> None:
    family = cloth_scene.family(document(), PLACES)
    run = family.scene().run()
    assert {0.1, 0.15} <= set(run.step_ends.tolist())
    other = replace(family.scene(lift=0.021), step_ends=run.step_ends).run()
    assert np.array_equal(other.step_ends, run.step_ends)


def test_outcome_has_arrays_and_labels() -> None:
    outcome = drag(frames=24).differentiated(["mu"]).outcome()
    assert outcome.record["positions_by_mu"].shape == outcome.record["positions"].shape
    assert outcome.record["nearest_event_by_mu"].shape == (24,)
    assert set(np.unique(outcome.record["one_sided_by_mu"])) <= {0, 1}
    largest = np.abs(outcome.record["positions_by_mu"]).max()
    assert outcome.labels["largest_by_mu"] == pytest.approx(largest, rel=1e-6)
    assert outcome.labels["unrefined_steps"] == 0


def document(**more: Any) -> dict[str, Any]:
    """Return a napkin that a gripper grasps in the air, over a table."""
    motion = {
        "about": None,
        "spin": None,
        "path": None,
        "interpolation": "linear",
        "ramp": 0.1,
        "keys": [
            {"time": 0.0, "move": [0.0, 0.0, 0.0], "turn": [0.0, 0.0, 0.0]},
            {"time": 0.5, "move": [0.05, 0.0, 0.02], "turn": [0.0, 0.4, 0.0]},
        ],
    }
    edges = {"rim": None, "vertices": None, "low": None, "high": None}
    sheet = {
        "material": "gray-interlock",
        "factors": {"density": 1.0, "bending": 1.0, "stretching": 1.0},
        "mesh": {"type": "grid", "size": [0.1, 0.06], "cells": [10, 6]},
        "origin": [0.0, 0.0, 0.01],
        "turn": [0.0, 0.0, 0.0],
        "start": {"type": "flat"},
        "self_contact": False,
        "thickness": 5e-4,
        "holders": {
            "first": {**edges, "edge": "left", "grasp": [0.0, 0.15], "motion": None},
            "second": {**edges, "edge": "right", "grasp": [0.1, 0.4], "motion": motion},
        },
    }
    return {
        "duration": 0.3,
        "end": None,
        "frame_rate": 20.0,
        "gravity": [0.0, 0.0, -9.81],
        "bias": None,
        "calm": None,
        "bearing": "all",
        "preset": "certified",
        "materials": {},
        "sheets": {"napkin": sheet},
        "bodies": {
            "ball": {
                "type": "sphere",
                "radius": 0.02,
                "origin": [0.0, 0.0, -0.012],
                "turn": [0.0, 0.0, 0.0],
                "motion": None,
            },
            "table": {"type": "plane", "normal": [0.0, 0.0, 1.0], "origin": [0.0, 0.0, -0.005]},
        },
        "friction": [
            {"between": ["napkin", "table"], "mu": 0.4},
            {"between": ["ball", "napkin"], "mu": 0.4},
        ],
        "default_friction": None,
        **more,
    }


PLACES = {
    "mu": FamilyParameter([["friction", 0, "mu"], ["friction", 1, "mu"]], 0.0, 1.0),
    "bending": FamilyParameter([["sheets", "napkin", "factors", "bending"]], 0.1, 10.0),
    "lift": FamilyParameter(
        [["sheets", "napkin", "holders", "second", "motion", "keys", 1, "move", 2]], 0.0, 0.1, "m"
    ),
    "pitch": FamilyParameter(
        [["sheets", "napkin", "holders", "second", "motion", "keys", 1, "turn", 1]], 0.0, 1.0
    ),
    "fall": FamilyParameter([["gravity", 2]], -20.0, -1.0, "m/s^2"),
    "ball": FamilyParameter([["bodies", "ball", "origin", 0]], -0.1, 0.1, "m"),
    "height": FamilyParameter([["sheets", "napkin", "origin", 2]], 0.009, 0.1, "m"),
    "radius": FamilyParameter([["bodies", "ball", "radius"]], 0.01, 0.03, "m"),
    "grasp": FamilyParameter(
        [["sheets", "napkin", "holders", "second", "grasp", 0]], 0.05, 0.2, "s"
    ),
}


@pytest.mark.parametrize("name", ["mu", "bending", "lift", "pitch", "fall", "ball", "height"])
def test_scene_with_grasps_is_differentiated(name: str) -> None:
    # A vertex that is grasped carries what it depended on before.
    # With steps of 20 ms the napkin has two solutions where it is let go, and rounding chooses.
    family = with_fixed_steps(cloth_scene.family(document(), PLACES), 0.005)
    assert relative_error(family, name, 1e-6, slice(1, None)) < 1e-4


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("radius", "'radius', which changes the shape of a body"),
        ("grasp", "'grasp', which changes the time at which a holder takes hold"),
        ("friction", "must be one of mu, bending, .* got 'friction'"),
    ],
)
def test_parameters_without_derivatives_are_refused(name: str, message: str) -> None:
    with pytest.raises(UnfitParameterError, match=message):
        cloth_scene.family(document(), PLACES).differentiated([name])


def changed_fabrics(low: Fabric, high: Fabric) -> SceneFamily:
    """Return drags of one fabric below the value 1 of a parameter, and of another from there."""

    def make(values: Mapping[str, float], hang: Any) -> Scene:
        other = high if values["kind"] >= 1.0 else low
        return cloth_drag.family(other, 0.3, mesh=7, frames=2).make(values, hang)

    plain = cloth_drag.family(low, 0.3, mesh=7, frames=2)
    return SceneFamily({**plain.parameters, "kind": SceneParameter(1.0, 0.0, 2.0)}, make)


def test_other_changes_of_bending_are_refused() -> None:
    plain = fabric("gray-interlock")
    coupled = plain.rigidity.copy()
    coupled[0, 1] = coupled[1, 0] = 0.1 * coupled[1, 1]
    for other, message in (
        (SOFTENED, "whether a fabric softens"),
        (replace(plain, rigidity=coupled), "not by factors of warp, weft and twist"),
    ):
        with pytest.raises(UnfitParameterError, match=message):
            changed_fabrics(plain, other).differentiated(["kind"])


def test_parameter_without_effect_is_labelled() -> None:
    far = {"type": "plane", "normal": [0.0, 0.0, 1.0], "origin": [0.0, 0.0, -1.0]}
    touching = [{"between": ["napkin", "table"], "mu": 0.4}]
    places = {"mu": FamilyParameter([["friction", 0, "mu"]], 0.0, 1.0)}
    scenes = cloth_scene.family(document(bodies={"table": far}, friction=touching), places)
    run = scenes.differentiated(["mu"]).run()
    assert run.labels["largest_by_mu"] == 0.0
    assert not run.sensitivities["mu"].has_effect


def sheet_at_rest(mu: float) -> SceneFamily:
    """Return a sheet that lies on a slope of tan 0.5."""
    slope = [0.0, 9.81 * np.sin(np.arctan(0.5)), -9.81 * np.cos(np.arctan(0.5))]
    napkin = document()["sheets"]["napkin"] | {"holders": {}, "origin": [0.0, 0.0, 0.0]}
    flat = document(
        gravity=slope,
        sheets={"napkin": napkin},
        bodies={"table": {"type": "plane", "normal": [0.0, 0.0, 1.0], "origin": [0.0, 0.0, 0.0]}},
        friction=[{"between": ["napkin", "table"], "mu": mu}],
    )
    return cloth_scene.family(flat, {"mu": FamilyParameter([["friction", 0, "mu"]], 0.0, 1.0)})


@pytest.mark.parametrize(("mu", "one_sided"), [(0.50001, True), (0.6, False)])
def test_event_within_the_change_is_flagged(mu: float, one_sided: bool) -> None:
    by = sheet_at_rest(mu).differentiated(["mu"]).run().sensitivities["mu"]
    assert by.one_sided.any() == one_sided
    assert by.nearest_event[2] == pytest.approx(mu - 0.5, rel=0.1)


def test_each_sheet_has_its_own_factors() -> None:
    napkin = document()["sheets"]["napkin"]
    other = napkin | {"origin": [0.0, 1.0, 0.01]}
    both = document(
        sheets={
            "a": napkin | {"self_contact": True},
            "b": other | {"self_contact": True},
        },
        friction=[],
        default_friction=0.4,
    )
    place = ["sheets", "b", "factors", "bending"]
    family = cloth_scene.family(both, {"bending": FamilyParameter([place], 0.1, 10.0)})
    by: Floats = family.differentiated(["bending"]).run().sensitivities["bending"].positions
    count = by.shape[1] // 2
    assert not by[:, :count].any()
    assert by[:, count:].any()
