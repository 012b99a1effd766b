"""Scenes of data in the solver: each built-in one, and what the language says about holders, starts
and bodies.
"""

import ast
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.kinds.cloth_scene import ClothSceneSimulation
from stickslip_schemas.plan.points import keyed_points
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.library import built_in_files, load_scene, scene_names
from stickslip_sim_core import ClothRun, fabric
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.scenes import cloth_scene
from stickslip_testing.worker import BUILDS

SHEET = {
    "material": "gray-interlock",
    "mesh": {"type": "grid", "size": [0.06, 0.06], "cells": [4, 4]},
}
WEIGHT = fabric("gray-interlock").density * 0.06**2 * GRAVITY


def physics(**scene: Any) -> dict[str, Any]:
    """Return the physics of a scene in which all rub with mu 0.5, with the preset `fast`."""
    document = {"format": "stickslip-scene/1", "preset": "fast", "default_friction": 0.5, **scene}
    return Scene.model_validate(document).physics()


def outcome_of(**scene: Any) -> ClothRun:
    run = cloth_scene.scene(physics(**scene), seed=1).run()
    assert run.valid, run.reason
    return run


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name, marks=pytest.mark.slow if any(load_scene(name).files()) else pytest.mark.physics
        )
        for name in scene_names()
    ],  # meshes of files cannot be made coarser
)
def test_a_built_in_scene_says_what_it_is_and_records_what_its_datasets_have(name: str) -> None:
    scene = load_scene(name)
    file = Path(__file__).parents[1] / f"schemas/src/stickslip_schemas/scenes/{name}.yaml"
    assert len(file.read_text().splitlines()) <= 80
    assert len(scene.description) > 80
    cells = {
        f"sheets.{each}.mesh.cells": [max(4, count // 2) for count in sheet.mesh.cells]
        for each, sheet in scene.sheets.items()
        if sheet.mesh.type == "grid"
    }
    length = {"end.at_most" if scene.end else "duration": 2.0 / scene.frame_rate}
    looks = {
        "texture": "dots",
        "viewpoint": next(iter(getattr(scene.looks.cameras, "keys", lambda: ["front"])())),
    }
    spec = job_spec_adapter.validate_python(
        {
            "kind": "cloth_scene",
            "scene": name,
            "axes": looks,
            "set": {**cells, **length},
            "store_positions": True,
            "frames": 2,
        }
    )
    (point,) = keyed_points(spec, BUILDS)
    simulation = spec.simulation_type.model_validate_json(point.simulation_text)
    assert isinstance(simulation, ClothSceneSimulation)
    (outcome,) = cloth_scene.KIND.simulate([simulation.inputs(built_in_files().__getitem__)], None)
    assert not outcome.reason
    values = {**outcome.record, **outcome.labels}
    for layout in spec.arrays():
        if layout.name in values:
            assert np.shape(values[layout.name]) == tuple(layout.shape), layout.name
    missing = {layout.name for layout in spec.arrays()} - set(values)
    assert not {
        name for name in missing if "." in name or name.startswith(("holder", "body", "contact"))
    }, missing


def test_no_code_knows_the_name_of_a_scene() -> None:
    """Names stand in the file's name alone: what a program does with a scene follows from its
    document.
    """
    root, names = Path(__file__).parents[1], set(scene_names())
    folders = (
        "schemas/src",
        "services/src",
        "workers",
        "training/src",
        "sim_core/python",
        "sim_core/src",
    )
    sources = [
        path
        for folder in folders
        for path in (root / folder).rglob("*.*")
        if "tests" not in path.parts
    ]
    knowing = []
    for path in sources:
        if path.suffix == ".py":
            tree = ast.parse(path.read_text(encoding="utf-8"))
            words = {str(node.value) for node in ast.walk(tree) if isinstance(node, ast.Constant)}
        elif path.suffix in (".js", ".html", ".cpp", ".hpp"):
            words = set(re.findall(r"[\"'`]([\w-]+)[\"'`]", path.read_text(encoding="utf-8")))
        else:
            continue
        knowing += [f"{path.relative_to(root)}: {word}" for word in sorted(words & names)]
    assert len(sources) > 300
    assert not knowing


@pytest.mark.physics
class TestLanguage:
    def test_sheets_on_a_floor_bear_each_other(self) -> None:
        sheets = {"a": SHEET, "b": SHEET | {"origin": [0, 0, 0.001]}}
        run = outcome_of(
            sheets=sheets, bodies={"floor": {"type": "plane"}}, duration=0.5, frame_rate=10
        )
        assert run.record["contact_force"].shape == (6, 2, 3, 3)  # frame, sheet, (floor, a, b), xyz
        z = run.record["contact_force"][-1, :, :, 2]
        assert z == pytest.approx(
            np.array([[2, 0, -1], [0, 1, 0]]) * WEIGHT, rel=2e-3, abs=1e-3 * WEIGHT
        )
        assert set(np.unique(run.record["b.contact"][-1])) <= {1, 2}
        assert not run.record["b.contact"][0].any()

    def test_frames_within_a_step_do_not_cross_where_its_ends_do_not(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A cloth is thrown on a peg.

        A cubic between the ends of a step reaches through a fold that it hits. The step control
        would have shorter steps in this impact.
        """
        document = load_scene("peg").model_dump(mode="json") | {"duration": 0.6, "frame_rate": 500}
        document["sheets"]["cloth"]["mesh"]["cells"] = [9, 9]
        thrown = cloth_scene.scene(Scene.model_validate(document).physics(), seed=1)
        steps = replace(thrown.preset, step_error=None, time_step=1 / 128)
        physics_scene = replace(thrown, preset=steps)
        run = physics_scene.run()
        # So few cells that are thrown may miss the error of steps that is allowed.
        assert run.code in ("", "step_error"), run.reason
        assert not run.self_intersections.any()
        smooth = Cloth.positions_at
        monkeypatch.setattr(
            Cloth, "positions_at", lambda cloth, time, straight=False: smooth(cloth, time)
        )
        assert physics_scene.run().code == "crossings"

    def test_a_release_lets_go_without_a_kick(self) -> None:
        """A sheet thrown upward flies on as it was moved: the mean of z falls by g t^2/2."""
        keys = [{"time": 0}, {"time": 0.5, "move": [0, 0, 1]}]
        holder = {"vertices": list(range(24)), "grasp": [0, 0.25], "motion": {"keys": keys}}
        run = outcome_of(
            sheets={"a": SHEET | {"holders": {"hand": holder}}},
            duration=0.5,
            frame_rate=20,
            preset="certified",
        )
        z, t = run.positions[:, :24, 2].mean(axis=1), run.times[5:] - 0.25
        assert z[5] == pytest.approx(0.5, abs=1e-9)
        assert z[5:] == pytest.approx(0.5 + 3.0 * t - 0.5 * GRAVITY * t**2, abs=8e-3)
        assert run.record["holder_force"][6:] == pytest.approx(np.zeros((5, 1, 3)))
        assert run.record["grasped"][:, 0].tolist() == [1] * 5 + [0] * 6

    def test_a_grasp_takes_vertices_where_they_are(self) -> None:
        """A sheet falls, is caught at a corner, and is lifted by it."""
        keys = [{"time": 0}, {"time": 0.1}, {"time": 1, "move": [0, 0, 0.05]}]
        hand = {
            "low": [0.029, 0.029],
            "high": [0.03, 0.03],
            "grasp": [0.1, 100],
            "motion": {"keys": keys},
        }
        run = outcome_of(
            sheets={"a": SHEET | {"holders": {"hand": hand}}}, duration=2.0, frame_rate=20
        )
        caught = run.positions[2, -1]
        assert caught[2] == pytest.approx(-0.5 * GRAVITY * 0.1**2, abs=5e-3)
        assert run.positions[-1, -1] == pytest.approx(caught + np.array([0.0, 0.0, 0.05]), abs=1e-9)
        # It swings, and hangs by its weight on average over the second in which the hand rests.
        resting = run.record["holder_force"][-20:, 0, 2]
        assert resting.mean() == pytest.approx(WEIGHT, rel=0.1)

    @pytest.mark.parametrize(("tilt", "slips"), [(0.9, False), (1.1, True)])
    def test_a_slab_that_tilts_lets_go_at_mu(self, tilt: float, slips: bool) -> None:
        keys = [{"time": 0}, {"time": 2, "turn": [0, float(np.arctan(tilt * 0.5)), 0]}]
        slab = {
            "type": "box",
            "size": [1, 1, 0.1],
            "origin": [0, 0, -0.05],
            "motion": {"keys": keys},
        }
        run = outcome_of(sheets={"a": SHEET}, bodies={"slab": slab}, duration=2.5, frame_rate=4)
        pose = run.record["body_pose"][-1, 0]
        along = (run.positions[-1] - pose[:, 3]) @ pose[:, 0]
        assert (along.mean() > 1e-3) == slips

    def test_a_scene_ends_at_rest_and_repeats_its_last_frame(self) -> None:
        end = {"when": "rest", "at_most": 3}
        run = outcome_of(
            sheets={"a": SHEET | {"origin": [0, 0, 0.002]}},
            bodies={"floor": {"type": "plane"}},
            end=end,
        )
        assert 0.25 <= run.rest_time < 1.5
        assert len(run.positions) == 91
        assert np.array_equal(run.positions[-1], run.positions[round(run.rest_time * 30)])

    def test_a_hung_sheet_starts_at_rest_and_a_stretched_one_stays(self) -> None:
        corners = {
            "a": {"low": [-0.03, 0.03], "high": [-0.03, 0.03]},
            "b": {"low": [0.03, 0.03], "high": [0.03, 0.03]},
        }
        hung = SHEET | {"turn": [1.5708, 0, 0], "start": {"type": "hung"}, "holders": corners}
        stretched = SHEET | {
            "origin": [1, 0, 0],
            "start": {"type": "stretched", "strain": [0.02, 0.01]},
        }
        sheets = {"hung": hung, "stretched": stretched | {"holders": {"frame": {"rim": True}}}}
        run = outcome_of(sheets=sheets, duration=0.3, frame_rate=10, gravity=[0, 0, -9.81])
        moved = np.abs(run.positions[-1] - run.positions[0])
        assert moved[:25].max() < 2e-3  # its tilt ends
        assert np.ptp(run.positions[0, 25:, 0]) == pytest.approx(0.06 * 1.02)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (
                {"holders": {"h": {"low": [0.001, 0.001], "high": [0.002, 0.002]}}},
                r"sheets.a.holders.h: must hold a",
            ),
            (
                {"holders": {"h": {"edge": "left"}, "i": {"rim": True}}},
                "sheets.a.holders.i: must not hold what",
            ),
        ],
    )
    def test_refusals(self, change: dict[str, Any], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            cloth_scene.scene(physics(sheets={"a": SHEET | change}, duration=0.1))
