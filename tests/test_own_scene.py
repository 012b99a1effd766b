"""A scene of a user, from its file to trajectories: the command line, the workers' program and the
core.
"""

import json
import subprocess
import sys
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from stickslip_schemas.documents.certificate import Certificate, CurveReport, ProtocolReport
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.files import with_arrays
from stickslip_services.cli import app
from stickslip_services.cli.specs import spec_of
from stickslip_services.local.making import why_uncertified
from stickslip_sim_core import fabric
from stickslip_sim_core.protocols import SCENE_PROTOCOLS
from stickslip_sim_core.scenes.cloth_scene import KIND, scene
from stickslip_workers.builds import solver_build

SOLVER = "stickslip_sim_core.cloth"
SCENE: dict[str, Any] = {
    "format": "stickslip-scene/1",
    "duration": 0.6,
    "frame_rate": 5.0,
    "preset": "fast",
    "sheets": {
        "cloth": {
            "material": "gray-interlock",
            "mesh": {"type": "grid", "size": [0.08, 0.06], "cells": [4, 3]},
            "origin": [0, 0, 0.052],
        }
    },
    "bodies": {
        "table": {
            "type": "mesh",
            "file": "table.obj",
            "motion": {"keys": [{"time": 0}, {"time": 0.4, "move": [0, 0, 0.02]}]},
        }
    },
    "default_friction": 0.5,
}
TABLE = "v -1 -1 0.05\nv 1 -1 0.05\nv 1 1 0.05\nv -1 1 0.05\nf 1 2 3 4\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "table.obj").write_text(TABLE)
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(SCENE))
    return tmp_path


def certificate(**change: Any) -> Certificate:
    """Return a certificate that vouches for the preset of the scene with this build, but for what
    is changed.
    """
    curve = CurveReport(parameters={}, x=(1.0,), measured=(1.0,), master=(1.0,), errors=(0.0,))
    protocols = tuple(
        ProtocolReport(
            protocol=name,
            x="x",
            y="y",
            tolerance=0.01,
            error=0.0,
            passed=True,
            settings={},
            build_hash="a" * 64,
            curves=(curve,),
        )
        for name in change.pop("names", SCENE_PROTOCOLS)
    )
    fields = {"preset": "fast", "sim_core": solver_build(SOLVER), "extent": "full"} | change
    return Certificate(
        numbers={},
        protocol_sources="b" * 64,
        protocols=protocols,
        passed=True,
        environment={},
        **fields,
    )


@pytest.mark.real
def test_from_the_file_to_trajectories(folder: Path) -> None:
    program = [sys.executable, "-m", "stickslip_services.cli", "simulate", "scene.yaml", "out"]
    refused = subprocess.run(program, cwd=folder, capture_output=True, text=True, check=False)
    assert refused.returncode == 1
    assert (
        "there is no certificate of preset fast; `stickslip certify --preset fast` makes one"
        in " ".join(refused.stderr.split())  # lines are as long as the terminal
    )
    assert not (folder / "out").exists()
    ended = subprocess.run(
        [*program, "--allow-uncertified", "--obj"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert "NOT certified: there is no certificate" in ended.stdout + ended.stderr
    document = json.loads((folder / "out" / "scene.json").read_text())
    assert document["valid"]
    assert not document["certified"]
    with np.load(folder / "out" / "trajectory.npz") as trajectory:
        path, forces = trajectory["cloth.positions"], trajectory["contact_force"]
        assert trajectory["cloth.rest"].shape == (20, 2)
    assert path.shape == (4, 20, 3)
    # The table has lifted it by 2 cm, and carries its weight.
    assert path[-1, :, 2] == pytest.approx(np.full(20, 0.07), abs=1e-3)
    weight = fabric("gray-interlock").density * 0.08 * 0.06 * 9.81
    assert forces[-1, 0, 0, 2] == pytest.approx(weight, rel=0.02)
    lines = (folder / "out" / "cloth" / "0003.obj").read_text().splitlines()
    assert [float(word) for word in lines[0].split()[1:]] == pytest.approx(path[3, 0], abs=1e-7)
    again = subprocess.run(
        [*program, "--allow-uncertified"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert again.returncode == 1
    assert "out: must not exist, and out does" in again.stderr


@pytest.mark.real
def test_a_file_that_is_wrong_is_refused_with_field_rule_and_value(folder: Path) -> None:
    scene = deepcopy(SCENE)
    scene["sheets"]["cloth"]["mesh"]["cells"] = [0, 3]
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    program = [sys.executable, "-m", "stickslip_services.cli", "simulate", "scene.yaml", "out"]
    ended = subprocess.run(program, cwd=folder, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    message = " ".join(ended.stderr.split())
    assert "sheets.cloth.mesh.cells.0: must be greater than or equal to 1, and it is 0" in message


def test_a_scene_is_checked_and_its_cost_named() -> None:
    """The cost is an interval that has the median of the samples that were measured."""
    document = json.loads(CliRunner().invoke(app, ["scene", "check", "peg", "--json"]).stdout)
    assert document["axes"]["speed"]["values"] == "-6 to 6 [rad/s]"
    assert {"cloth.positions", "cloth.contact", "mu", "fabric"} <= {
        array["name"] for array in document["arrays"]
    }
    cost = document["cost"]
    assert (cost["vertices"], cost["frames"]) == (441, 121)
    least, most = cost["cpu_seconds_a_sample"]
    results = Path(__file__).parents[1] / "benchmarks/results/scenes.json"
    (row,) = (row for row in json.loads(results.read_text())["rows"] if row["scene"] == "peg")
    assert least < row["CPU s a sample, least, median, most"][1] < most
    output = CliRunner().invoke(app, ["scene", "check", "peg"], env={"COLUMNS": "200"}).output
    assert f"takes {least:.2g} to {most:.2g} CPU s" in " ".join(output.split())


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({}, ""),
        ({"preset": "certified"}, "the certificate is of preset certified, and the scene has fast"),
        ({"extent": "quick"}, "the certificate is a quick one"),
        ({"sim_core": "c" * 64}, "the certificate is of another build of the solver"),
        ({"names": SCENE_PROTOCOLS[:4]}, "the certificate lacks what the scene needs: capstan"),
    ],
)
def test_a_scene_is_certified_by_what_it_touches(change: dict[str, Any], why: str) -> None:
    reason = why_uncertified(
        spec_of(Scene.model_validate(SCENE)), certificate(**change), solver_build(SOLVER)
    )
    assert reason.startswith(why)
    assert bool(reason) == bool(why)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("turn", [0, 0.5, 0], "surface"),
        (
            "holders",
            {"hand": {"low": [5, 5], "high": [6, 6]}},
            "sheets.cloth.holders.hand: must hold a vertex",
        ),
        (
            "holders",
            {n: {"low": [0, 0], "high": [1, 1]} for n in "ab"},
            "sheets.cloth.holders.b: must not hold",
        ),
    ],
)
def test_a_scene_that_cannot_be_is_not_valid(place: str, value: Any, message: str) -> None:
    scene_document = deepcopy(SCENE)
    scene_document["sheets"]["cloth"][place] = value
    physics = with_arrays(Scene.model_validate(scene_document), lambda _name: TABLE.encode())
    (outcome,) = KIND.simulate([{"scene": physics, "seed": 0}], None)
    assert message in outcome.reason


RIDGE = """
v -0.001 -1 -0.05
v 0 -1 0
v 0.001 -1 -0.05
v -0.001 1 -0.05
v 0 1 0
v 0.001 1 -0.05
f 1 2 5 4
f 2 3 6 5
"""
"""A ridge along y, whose crest is at x = 0 and z = 0."""


@pytest.mark.physics
def test_a_vertex_beyond_the_nearest_to_a_ridge_is_not_in_contact() -> None:
    """A sheet with cells of 1 cm falls on a ridge that is 2 mm beside a row of vertices: edges
    bear, and the next row, 8 mm away, touches nothing.
    """
    ridge_scene = {
        "format": "stickslip-scene/1",
        "duration": 0.1,
        "frame_rate": 20,
        "default_friction": 0.5,
        "sheets": {
            "cloth": {
                "material": "gray-interlock",
                "mesh": {"type": "grid", "size": [0.04, 0.04], "cells": [4, 4]},
                "origin": [0.002, 0.0, 0.0012],
            }
        },
        "bodies": {"ridge": {"type": "mesh", "file": "ridge.obj", "thickness": 0.0005}},
    }
    physics = with_arrays(Scene.model_validate(ridge_scene), lambda _name: RIDGE.encode())
    run = scene(physics, seed=0).run()
    # The ridge is too sharp for these cells, and a run may be rejected for its friction.
    assert run.code in ("", "friction_error"), run.reason
    touches = run.record["cloth.contact"][-1] > 0
    assert touches.any()
    assert np.abs(run.positions[-1, touches, 0]).max() < 0.006
