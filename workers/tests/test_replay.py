"""Replay: one task on this machine, with the result that a worker would have reported."""

import json
import sys
from pathlib import Path

import fake_renderer
import pytest
from stickslip_schemas.base import Reason
from stickslip_schemas.documents.tasks import (
    RecordRef,
    RenderTask,
    SimulateTask,
    TaskResult,
    task_adapter,
)
from stickslip_schemas.kinds import KINDS
from stickslip_schemas.kinds.rod_hang import RodHangRender, RodHangSimulation
from stickslip_schemas.store import DirectoryStore
from stickslip_workers.__main__ import main
from stickslip_workers.commands import replay


def test_the_command_prints_the_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    task = SimulateTask(simulation=RodHangSimulation(gamma=9.0, phi0=1.0, phi1=2.0, poisson=0.5))
    (tmp_path / "task.json").write_bytes(task_adapter.dump_json(task))
    assert main(["replay", str(tmp_path / "task.json"), "--store", str(tmp_path / "store")]) == 0
    result = TaskResult.model_validate_json(capsys.readouterr().out)
    assert result.outcome == "succeeded"
    assert DirectoryStore(tmp_path / "store").path(result.output.record.digest).exists()


@pytest.mark.parametrize("behaviour", [fake_renderer.FINE, fake_renderer.BUG])
def test_a_render_runs_in_the_other_interpreter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, behaviour: int
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(fake_renderer.__file__).parent))
    look = RodHangRender(rig="rod-4", rig_digest="0" * 64, quality="draft", color_seed=behaviour)
    task = RenderTask(render=look, record=RecordRef(digest="0" * 64, row=0))
    result = replay(
        task,
        store=str(tmp_path),
        blender_python=Path(sys.executable),
        render_actor="fake_renderer:RenderActor",
    )
    if behaviour == fake_renderer.FINE:
        assert result.outcome == "succeeded"
    else:
        assert (result.reason, result.message) == (
            Reason.renderer_crash,
            "the renderer ended with status 1",
        )


def test_describe_names_the_builds(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["describe"]) == 0
    described = json.loads(capsys.readouterr().out)
    assert described["builds"].keys() == KINDS.keys()
    for builds in described["builds"].values():
        assert {stage: len(digest) for stage, digest in builds.items()} == {
            "sim_core": 64,
            "simulate": 64,
            "pack": 64,
        }


def test_a_task_that_is_none_is_said_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(tmp_path / "nope.json"), "--store", str(tmp_path)]) == 2
    assert "nope.json cannot be read: No such file" in capsys.readouterr().err
    (tmp_path / "other.json").write_text("{}")
    assert main(["replay", str(tmp_path / "other.json"), "--store", str(tmp_path)]) == 2
    assert "other.json is not a task" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command", [["replay", "task.json"], ["dispatch", "--url", "http://127.0.0.1:1", "--name", "x"]]
)
def test_a_place_that_is_no_store_is_refused(
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main([*command, "--store", "s3:/lab/store"])
    assert ended.value.code == 2
    assert (
        "argument --store: store must be a directory, file:///DIRECTORY or s3://BUCKET"
        in capsys.readouterr().err
    )
    assert list(tmp_path.iterdir()) == []
