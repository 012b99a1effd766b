import json
import re

import pytest
from stickslip_training.cli import app
from typer.testing import CliRunner

runner = CliRunner(env={"COLUMNS": "120", "NO_COLOR": "1"})


def test_info_says_what_is_in_a_dataset(clips):
    result = runner.invoke(app, ["info", str(clips.root), "--verify"])
    assert result.exit_code == 0, result.output
    counts = clips.manifest.split_counts
    assert (
        f"10 of 12 valid: {counts['train']} train, {counts['validation']} validation"
        in result.output
    )
    assert "83.3%; rejected: 2 out_of_frame" in result.output
    assert clips.manifest.certificate in result.output
    assert "verified" in result.output
    assert re.search(r"video +uint8 +12 × 2 × 224 × 224 × 3 +3\.6 MB", result.output)


@pytest.mark.physics
def test_curvature_trains_and_writes(rods, tmp_path):
    pytest.importorskip("matplotlib")
    out = tmp_path / "out"
    options = ["--steps", "2", "--noise", "0.01", "--threads", "1", "--batch-size", "20"]
    result = runner.invoke(app, ["curvature", str(rods.root), "--out", str(out), *options])
    assert result.exit_code == 0, result.output
    for line in (
        "network",
        "quintic spline",
        "cubic spline",
        "finite differences",
        "at 1.00% noise",
        "Note: There are",
    ):
        assert line in result.output
    assert json.loads((out / "report.json").read_text())["config"]["noise"] == 0.01
    assert (out / "model.pt").is_file()
    more = runner.invoke(
        app,
        ["curvature", str(rods.root), "--out", str(out), "--resume", *options[2:], "--steps", "4"],
    )
    assert more.exit_code == 0, more.output
    assert len(json.loads((out / "report.json").read_text())["history"]) == 2


@pytest.mark.parametrize("command", [["info"], ["curvature", "--out", "out"]])
def test_a_mistake_is_one_line_and_status_1(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = runner.invoke(app, [command[0], "nowhere", *command[1:]])
    assert result.exit_code == 1
    assert result.stderr == (
        "stickslip-train: nowhere/manifest.json is not there: this is no committed "
        "dataset version\n"
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif("__import__('torch').cuda.is_available()", reason="this torch has CUDA")
def test_a_device_that_torch_cannot_use_is_said_in_a_line(rods, tmp_path):
    result = runner.invoke(
        app, ["curvature", str(rods.root), "--out", str(tmp_path / "out"), "--device", "cuda"]
    )
    assert result.exit_code == 1
    assert "device must be one that torch can use here" in result.output
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    "command",
    [
        ["--help"],
        ["info", "--help"],
        ["export", "--help"],
        ["curvature", "--help"],
        ["reconstruct", "--help"],
        ["cloth", "train", "--help"],
        ["cloth", "predict", "--help"],
        ["benchmark", "score", "--help"],
        ["benchmark", "list"],
        ["info", "DATASET"],
    ],
)
def test_every_table_fits_80_columns(command, clips):
    command = [str(clips.root) if word == "DATASET" else word for word in command]
    result = CliRunner(env={"COLUMNS": "80", "NO_COLOR": "1"}).invoke(app, command)
    assert result.output
    assert "Traceback" not in result.output
    too_long = [line for line in result.output.splitlines() if len(line) > 80]
    assert too_long == []


def test_a_selection_of_nothing_fails(clips, tmp_path):
    nothing = ["export", str(clips.root), "--webdataset", str(tmp_path / "out"), "--where", "mu>9"]
    result = runner.invoke(app, nothing)
    assert result.exit_code == 1
    assert "no valid sample is in this part of the dataset" in result.output
    assert list(tmp_path.iterdir()) == []
