"""The rules by which a scene cannot start are those of the simulation core."""

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from stickslip_schemas.base import Reason
from stickslip_schemas.documents.tasks import SimulateTask
from stickslip_schemas.kinds.cloth_scene import ClothSceneSimulation
from stickslip_schemas.scene import motions as checked_motions
from stickslip_schemas.scene import shapes
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.files import with_arrays
from stickslip_schemas.scene.motions import SHORTEST_STEPS, Track
from stickslip_schemas.scene.sheets import start_of
from stickslip_schemas.scene.start import MAX_EXTENT, find_start_faults
from stickslip_schemas.store import DirectoryStore
from stickslip_sim_core.cloth import contact, meshes, presets, solver
from stickslip_sim_core.scenes import cloth_scene, motions, parts
from stickslip_sim_core.scenes.kind import IMPOSSIBLE_START
from stickslip_workers.stages.run import run_tasks

SCENE: dict[str, Any] = {
    "format": "stickslip-scene/1",
    "duration": 0.1,
    "preset": "fast",
    "sheets": {
        "cloth": {
            "material": "gray-interlock",
            "mesh": {"type": "grid", "size": [0.1, 0.1], "cells": [4, 4]},
            "origin": [0.0, 0.0, 0.06],
        },
    },
    "bodies": {"floor": {"type": "plane"}},
    "default_friction": 0.4,
}


LARGE = {"type": "grid", "size": [9.0, 9.0], "cells": [4, 4]}


def physics(**changes: Any) -> dict[str, Any]:
    document = deepcopy(SCENE)
    document["sheets"]["cloth"].update(changes.pop("cloth", {}))
    document["bodies"].update(changes.pop("bodies", {}))
    document["sheets"].update(changes.pop("sheets", {}))
    scene = Scene.model_validate({**document, **changes})
    return with_arrays(scene, lambda _name: b"")


@pytest.mark.parametrize(
    "changes",
    [
        {
            "cloth": {"mesh": LARGE},
            "sheets": {
                name: {"material": "gray-interlock", "mesh": LARGE, "origin": [0, 0, height]}
                for name, height in (("other", 1.0), ("third", 2.0))
            },
        },
        {"cloth": {"mesh": {"type": "grid", "size": [0.002, 0.002], "cells": [4, 4]}}},
        {"cloth": {"holders": {"h": {"low": [0.06, 0.06], "high": [0.08, 0.08]}}}},
        {"cloth": {"holders": {"g": {"edge": "top"}, "h": {"edge": "left"}}}},
        {"cloth": {"holders": {"h": {"low": [-1, -1], "high": [1, 1]}}}},
        {"cloth": {"origin": [0.0, 0.0, -0.001]}},
        {"bodies": {"ball": {"type": "sphere", "radius": 0.03, "origin": [0, 0, 0.05]}}},
        {"bodies": {"rod": {"type": "cylinder", "radius": 0.03, "origin": [0, 0, 0.05]}}},
        {"bodies": {"rod": {"type": "cylinder", "radius": 0.0224, "origin": [0, 0, -0.5]}}},
        {"bodies": {"plate": {"type": "box", "size": [1, 1, 0.04], "origin": [0, 0, -0.5]}}},
        {
            "bodies": {
                "bone": {"type": "capsule", "radius": 0.02, "length": 0.1, "origin": [0, 0, 0.05]}
            }
        },
        {
            "bodies": {
                "box": {
                    "type": "box",
                    "size": [0.06, 0.06, 0.1],
                    "origin": [0.02, 0, 0.05],
                    "turn": [0.3, 0, 0.4],
                }
            }
        },
        {"sheets": {"other": {**SCENE["sheets"]["cloth"], "turn": [1.2, 0.1, 0.0]}}},
    ],
)
def test_the_core_refuses_what_the_check_refuses(changes: dict[str, Any]) -> None:
    document = physics(**changes)
    assert find_start_faults(document)
    (outcome,) = cloth_scene.KIND.simulate([{"scene": document, "seed": 0}], None)
    assert outcome.code == IMPOSSIBLE_START
    assert outcome.reason


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"cloth": {"origin": [0.0, 0.0, 0.0]}},
        {"cloth": {"mesh": {"type": "grid", "size": [0.003, 0.003], "cells": [4, 4]}}},
        {"cloth": {"holders": {"h": {"edge": "left"}}}},
        {"sheets": {"other": {**SCENE["sheets"]["cloth"], "origin": [0, 0, 0.0601]}}},
    ],
)
def test_the_core_begins_what_the_check_passes(changes: dict[str, Any]) -> None:
    document = physics(**changes)
    assert find_start_faults(document) == []
    begun = cloth_scene.scene(document).begin()
    assert np.isfinite(begun.cloth.positions).all()


def test_a_task_is_rejected_before_it_runs(store: DirectoryStore) -> None:
    document = deepcopy(SCENE)
    document["sheets"]["other"] = deepcopy(document["sheets"]["cloth"])
    simulation = ClothSceneSimulation.model_validate({"scene": document, "seed": 1})
    (result,) = run_tasks([SimulateTask(simulation=simulation)], store)
    assert (result.outcome, result.reason) == ("rejected", Reason.impossible_start)
    assert result.message.startswith("sheets.other.origin: must not lie in sheet cloth")


def test_an_error_of_the_run_is_a_bug(
    store: DirectoryStore, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A ValueError in a step is no property of the scene, so it is not called a rejection."""

    def advance(*_arguments: Any, **_options: Any) -> None:
        raise ValueError("a bug in a step")

    monkeypatch.setattr(solver.Cloth, "advance", advance)
    simulation = ClothSceneSimulation.model_validate({"scene": SCENE, "seed": 1})
    (result,) = run_tasks([SimulateTask(simulation=simulation)], store)
    assert (result.outcome, result.reason) == ("failed", Reason.internal_error)
    assert "a bug in a step" in caplog.text
    assert "Traceback" in caplog.text


def test_the_numbers_are_those_of_the_core() -> None:
    assert MAX_EXTENT == solver.EXTENT_MAX
    assert shapes.ROUNDING == contact.ROUNDING
    assert shapes.RADIUS_LEAST == contact.RADIUS_LEAST
    for size, cell in (([1, 1, 1], 0.001), ([1, 1, 1], 0.01), ([1, 1, 0.012], 0.01)):
        rounding = shapes.box_rounding({"size": size, "rounding": None}, cell)
        assert rounding == contact.default_rounding(size, cell)
    assert set(SHORTEST_STEPS) == set(presets.PRESETS)
    for name, settings in presets.PRESETS.items():
        shortest = settings.longest_step / settings.finest
        if settings.step_error is None:
            shortest = settings.time_step
        assert SHORTEST_STEPS[name] == (shortest, settings.step_error or presets.STEP_ERROR)


@pytest.mark.parametrize(
    "options", [{}, {"interpolation": "linear"}, {"interpolation": "linear", "ramp": 0.05}]
)
def test_motions_are_those_of_the_core(options: dict[str, Any]) -> None:
    moves = [[0, 0, 0], [0.1, 0, 0.2], [0.15, -0.1, 0.2], [0.1, 0, 0.5]]
    turns = [[0, 0, 0], [0, 0.2, 0], [0, 0.5, 0.1], [0, 0.4, 0.2]]
    times = [0.1, 0.3, 0.7, 0.8]
    motion = {
        "keys": [
            {"time": time, "move": move, "turn": turn}
            for time, move, turn in zip(times, moves, turns, strict=True)
        ],
        "spin": None,
        "path": None,
        "about": [0.1, 0.2, 0.3],
        "interpolation": "smooth",
        "ramp": 0.0,
        **options,
    }
    core = parts.rigid_motion(motion, np.zeros(3))
    assert isinstance(core, motions.Keyframes)
    instants = np.linspace(0.0, 1.0, 101)
    values = Track(motion).at(instants)
    poses = core.pose(instants)
    for value, pose in zip(values, poses, strict=True):
        turn = checked_motions.rotation_matrix(value[3:])
        about = np.array(motion["about"])
        np.testing.assert_allclose(turn, pose[:, :3], atol=1e-12)
        np.testing.assert_allclose(about + value[:3] - turn @ about, pose[:, 3], atol=1e-12)


def test_sheets_are_those_of_the_core() -> None:
    document = physics(
        cloth={
            "mesh": {"type": "grid", "size": [0.1, 0.07], "cells": [5, 3]},
            "turn": [0.1, -0.4, 0.2],
            "start": {"type": "stretched", "strain": [0.05, -0.02]},
        }
    )
    sheet = document["sheets"]["cloth"]
    start = start_of("cloth", sheet)
    core = parts.sheet("cloth", sheet, {}, gravity=document["gravity"], seed=0, kernel=None)
    assert start.cell == pytest.approx(core.mesh.spacing, rel=1e-12)
    np.testing.assert_allclose(start.positions, core.start, atol=1e-15)
    np.testing.assert_array_equal(start.mesh.triangles, core.mesh.triangles)


def test_a_scattered_sheet_is_within_its_jitter() -> None:
    mesh = {"type": "unstructured", "size": [0.1, 0.07], "spacing": 0.01, "seed": 3}
    document = physics(cloth={"mesh": mesh})
    lattice = start_of("cloth", document["sheets"]["cloth"])
    scattered = meshes.unstructured(0.1, 0.07, 0.01, 3)
    assert lattice.cell == pytest.approx(scattered.spacing, rel=1e-12)
    offsets = scattered.rest[:, None] - lattice.rest[None]
    assert np.linalg.norm(offsets, axis=2).min(axis=1).max() <= lattice.jitter
