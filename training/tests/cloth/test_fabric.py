import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from stickslip_training.cli import app
from stickslip_training.cloth.clips import render_clips
from stickslip_training.cloth.fabric import FABRIC, fabric_intervals, fabric_numbers, score_fabric
from stickslip_training.cloth.learner import ClothTraining, FrictionLearner, train_friction
from stickslip_training.cloth.model import load_friction, save_friction
from stickslip_training.cloth.nets import PosteriorNet
from stickslip_training.cloth.runs import load_runs
from typer.testing import CliRunner

FABRICS = Path(__file__).with_name("fabrics.npz")
SMALL = ClothTraining(steps=3, batch_size=4, width=16, fabric=True)
LENGTH = FABRIC[2]


@pytest.fixture(scope="module")
def fabrics():
    """24 simulations of three fabrics whose mass and rigidity were multiplied, as `cloth_runs.py` packs them."""
    return load_runs(FABRICS)


@pytest.fixture(scope="module")
def parts(fabrics):
    number = np.arange(len(fabrics))
    return fabrics[number[number % 4 > 0]], fabrics[number[number % 4 == 0]]


@pytest.fixture(scope="module")
def model(parts):
    return train_friction(*parts, SMALL, epoch=3)


# --- numbers --------------------------------------------------------------------------------------------------


def test_the_numbers_of_a_fabric():
    rigidity = np.array([[3.994e-6, 7.646e-6, 1.8e-6], [7.988e-6, 15.292e-6, 0.0]])  # gray-interlock; twice as stiff
    density, bending, length = (10 ** fabric_numbers(np.array([0.187, 0.374]), rigidity)).T
    assert density == pytest.approx([0.187, 0.374])
    assert bending == pytest.approx([5.82e-6, 11.64e-6], rel=1e-3)
    assert length == pytest.approx([0.01469, 0.01469], rel=1e-3)  # and twice as heavy: it hangs the same


def test_packed_fabrics_are_told_as_they_were_simulated(fabrics):
    with np.load(FABRICS) as file:
        about = [json.loads(str(line)) for line in file["about"]]
    assert 10 ** fabrics.fabric[:, 0] == pytest.approx([run["areal_density"] for run in about])
    assert all(
        quantity.bins.low < column.min() < column.max() < quantity.bins.high
        for quantity, column in zip(FABRIC, fabrics.fabric.T, strict=True)
    )
    spread = [np.ptp(fabrics.fabric[fabrics.material == code], axis=0) for code in range(3)]
    assert np.min(spread, axis=0)[[0, 1]] == pytest.approx([np.log10(2.25), np.log10(6.25)], rel=0.3)


def test_runs_of_older_files_have_no_numbers(runs):
    assert np.isnan(runs.fabric).all()
    with pytest.raises(ValueError, match=r"areal_density of the runs must be known, from 0.056 to"):
        train_friction(runs[np.arange(6)], runs[np.arange(6, 8)], SMALL)


# --- scores ---------------------------------------------------------------------------------------------------


def test_scores_of_known_histograms():
    generator = np.random.default_rng(0)
    count, deviation = 2000, 0.05
    material = np.arange(count) % 2
    truth = np.tile(generator.uniform(-1.8, -1.6, count)[:, None], (1, 3)) + 0.1 * material[:, None]
    seen = truth[:, 2] + deviation * generator.standard_normal(count)
    histogram = np.exp(-0.5 * ((LENGTH.bins.centers - seen[:, None]) / deviation) ** 2)
    found = score_fabric((LENGTH,), {LENGTH.name: histogram}, truth, material, np.arange(count))[LENGTH.name]
    assert found.error.value == pytest.approx(np.log(10) * deviation * np.sqrt(2 / np.pi), rel=0.05)
    assert found.guess.value == pytest.approx(np.log(10) * 0.2 / 4, rel=0.05)  # the materials' mean is known, not more
    assert found.coverage.value == pytest.approx(0.8, abs=0.03)
    assert found.width.value == pytest.approx(np.log(10) * 2 * 1.2816 * deviation, rel=0.05)
    told = fabric_intervals((LENGTH,), {LENGTH.name: histogram})[LENGTH.name]
    assert told[0]["low"] < told[0]["median"] < told[0]["high"]
    assert told[5]["median"] == pytest.approx(10 ** seen[5], rel=0.02)


# --- training -------------------------------------------------------------------------------------------------


def test_heads_of_quantities_leave_the_rest_of_the_network_as_it_was():
    nets = []
    for quantities in ((), (48, 48)):
        torch.manual_seed(0)
        nets.append(PosteriorNet(materials=3, bins=64, frames=6, width=16, quantities=quantities).state_dict())
    assert all(torch.equal(tensor, nets[1][name]) for name, tensor in nets[0].items())
    assert len(nets[1]) == len(nets[0]) + 4


@pytest.mark.physics
def test_a_model_tells_histograms_of_a_fabric_and_is_read_back(model, parts, tmp_path):
    clips = render_clips(parts[1], 1, 0)
    told = model.fabric(clips)
    assert set(told) == {quantity.name for quantity in FABRIC}
    assert all(histogram.sum(axis=1) == pytest.approx(1.0) for histogram in told.values())
    assert len(model.quantity_temperatures) == 3
    save_friction(tmp_path / "model.safetensors", model)
    read = load_friction(tmp_path / "model.safetensors")
    assert (read.quantities, read.quantity_temperatures) == (FABRIC, model.quantity_temperatures)
    assert all(np.array_equal(histogram, told[name]) for name, histogram in read.fabric(clips).items())
    again = train_friction(*parts, SMALL, epoch=3)
    assert all(np.array_equal(histogram, told[name]) for name, histogram in again.fabric(clips).items())


@pytest.mark.slow
def test_it_goes_on_from_the_weights_of_the_package_and_learns_its_new_heads(parts, monkeypatch):
    """These know more fabrics, and friction only."""
    start = load_friction()
    assert start.quantities == ()
    named = [part.named(start.materials) for part in parts]
    learner = FrictionLearner(*named, replace(SMALL, width=96, batch_size=6, smoothing=(0.02, 0.02)), start=start)
    weights = learner.net.state_dict()
    assert all(torch.equal(weights[name], tensor) for name, tensor in start.net.state_dict().items())
    batch = learner.batch(0)
    monkeypatch.setattr(learner, "batch", lambda step: batch)
    place = torch.from_numpy(LENGTH.bins.place(batch[4][:, 2].numpy()))

    def ignorance():
        told = learner.net.read_quantities(learner.net.features(*batch[:2]))[2]
        return -float(told[torch.arange(6), place].detach().mean())

    learner.net.eval()
    before = ignorance()
    optimizer = torch.optim.AdamW(learner.net.parameters(), lr=3e-3)
    for _ in range(12):
        optimizer.zero_grad()
        learner.loss(learner.net, 0).backward()
        optimizer.step()
    assert ignorance() < before - 0.3
    with pytest.raises(ValueError, match="materials must have those of the runs, and lack"):
        parts[0].named(start.materials[:3])


@pytest.mark.physics
def test_the_commands_tell_the_fabric(tmp_path):
    runner = CliRunner(env={"COLUMNS": "160", "NO_COLOR": "1"})
    out = tmp_path / "run"
    command = ["cloth", "train", str(FABRICS), "--out", str(out), "--threads", "1", "--steps", "2", "--fabric"]
    trained = runner.invoke(app, command)
    assert trained.exit_code == 0, trained.output
    model = str(out / "friction.safetensors")
    judged = runner.invoke(
        app, ["cloth", "evaluate", model, str(FABRICS), "--out", str(out / "told"), "--renders", "1"]
    )
    assert judged.exit_code == 0, judged.output
    assert "bending length" in judged.stdout
    assert "knowing only the material" in judged.stdout
    report = json.loads((out / "told" / "report.json").read_text())
    assert set(report["fabric"]) == {quantity.name for quantity in FABRIC}
    assert 0 <= report["fabric"]["areal_density"]["coverage"]["value"] <= 1
