import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from stickslip_training.data.reader import DatasetReader
from stickslip_training.rods import curvature
from stickslip_training.rods.curvature import (
    TEST,
    CurvatureNet,
    CurvatureTraining,
    load_model,
    load_splits,
    train_curvature,
)
from stickslip_training.rods.evaluation import estimate_strains, with_white_noise
from torch import nn

pytestmark = pytest.mark.physics


class SmallNet(CurvatureNet):
    """The network with an eighth of its hidden units: its checkpoints of 200 MB would take most of
    the time.
    """

    def __init__(self):
        super().__init__()
        self.head[1], self.head[3] = (
            nn.Linear(self.head[1].in_features, 64),
            nn.Linear(64, self.head[3].out_features),
        )


@pytest.fixture(scope="module", autouse=True)
def small():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(curvature, "CurvatureNet", SmallNet)
        yield


@pytest.fixture
def config(rods, tmp_path):
    """36 rods or so, in three steps an epoch."""
    return CurvatureTraining(
        dataset=str(rods.root), out=tmp_path / "out", steps=6, batch_size=15, threads=1
    )


@pytest.fixture(scope="module")
def trained(rods, tmp_path_factory):
    """One run that is long enough to learn something."""
    out = tmp_path_factory.mktemp("run")
    config = CurvatureTraining(
        dataset=str(rods.root), out=out, steps=60, batch_size=8, noise=0.001, threads=1
    )
    return config, train_curvature(config)


def weights(report_or_config):
    return torch.load(report_or_config.out / "model.pt", weights_only=True)["net"]


def test_the_loss_falls(trained):
    _, report = trained
    validation = {epoch["step"]: epoch["validation_loss"] for epoch in report["history"]}
    assert len(validation) == 12
    assert validation[report["best_step"]] == min(validation.values())
    assert min(validation.values()) < 0.85 * report["history"][0]["validation_loss"]


def test_the_report_measures_the_model_that_is_saved(trained, rods):
    config, report = trained
    assert [method["method"] for method in report["methods"]] == [
        "network",
        "quintic spline",
        "cubic spline",
        "finite differences",
    ]
    assert json.loads((config.out / "report.json").read_text())["test_loss"] == report["test_loss"]
    with DatasetReader(rods.root) as reader:
        test, slots = load_splits(reader, config.evaluation_rods)[0]["test"], reader.slots("test")
    noisy = with_white_noise(test.centerline, config.noise, (config.seed, TEST))
    assert np.array_equal(test.centerline, rods.arrays["centerline"][slots])
    assert 0.0009 < (noisy - test.centerline).std() < 0.0011
    strains = estimate_strains(load_model(config.out / "model.pt"), noisy)
    assert np.sqrt(np.mean((strains - test.strains) ** 2)) == pytest.approx(
        report["test_loss"], rel=1e-5
    )
    estimate, truth = (
        np.hypot(values[..., 1], values[..., 2]) for values in (strains, test.strains)
    )
    errors = np.linalg.norm(estimate - truth, axis=1) / np.linalg.norm(truth, axis=1)
    assert report["methods"][0]["relative_median"] == pytest.approx(np.median(errors), rel=1e-5)
    assert report["rods"] == dict(rods.manifest.split_counts)
    assert report["certificate"] == rods.manifest.certificate
    assert report["parameters"] == sum(weight.numel() for weight in SmallNet().parameters())


def test_few_test_rods_are_told(trained):
    assert len(trained[1]["notes"]) == 1
    assert trained[1]["notes"][0].startswith(
        f"There are only {trained[1]['rods']['test']} test rods"
    )


@pytest.mark.physics
def test_a_run_of_the_same_config_and_seed_gives_the_same_weights_also_where_it_was_resumed(
    config, tmp_path
):
    straight = train_curvature(config)
    stopped = replace(config, out=tmp_path / "stopped", steps=4)
    assert train_curvature(stopped)["steps"] == 4  # within the second epoch
    resumed = train_curvature(replace(config, out=stopped.out), resume=True)
    assert [
        (epoch["step"], epoch["train_loss"], epoch["validation_loss"])
        for epoch in resumed["history"]
    ] == [
        (epoch["step"], epoch["train_loss"], epoch["validation_loss"])
        for epoch in straight["history"]
    ]
    for name, tensor in weights(config).items():
        assert torch.equal(tensor, weights(stopped)[name])
    other = replace(config, out=tmp_path / "other", seed=1)
    assert (
        train_curvature(other)["history"][0]["train_loss"] != straight["history"][0]["train_loss"]
    )
    assert not torch.equal(weights(config)["head.3.weight"], weights(other)["head.3.weight"])
    with pytest.raises(
        ValueError, match=r"noise must be that of the run that is resumed, 0\.005, and is 0\.1"
    ):
        train_curvature(replace(stopped, noise=0.1), resume=True)
    with pytest.raises(ValueError, match="there is nothing to resume"):
        train_curvature(replace(config, out=tmp_path / "nothing"), resume=True)


@pytest.mark.physics
def test_the_model_is_the_average_of_the_weights_or_the_last_ones(config, tmp_path):
    def net_of(file):
        return torch.load(file, weights_only=True)["net"]["head.3.weight"]

    config = replace(config, steps=3)
    train_curvature(config)
    last = replace(config, out=tmp_path / "last", averaging=0.0)
    train_curvature(last)
    weights = [net_of(each.out / "checkpoint.pt") for each in (config, last)]
    assert torch.equal(*weights)  # averaging changes nothing about the training itself
    assert torch.equal(net_of(last.out / "model.pt"), weights[1])
    assert not torch.equal(net_of(config.out / "model.pt"), weights[0])


@pytest.mark.physics
def test_an_empty_split_is_made_up_for_and_told(make_rods, tmp_path):
    axes = {"gamma": [200.0, 400.0, 800.0], "phi0": [1.0, 3.0], "phi1": 8.0}

    def run(name, **splits):
        version = make_rods(
            axes=axes, splits={"train": 0.0, "validation": 0.0, "test": 0.0} | splits
        )
        return train_curvature(
            CurvatureTraining(dataset=str(version.root), out=tmp_path / name, steps=1, threads=1)
        )

    only_train = run("train", train=1.0)
    assert only_train["rods"] == {"train": 6, "validation": 0, "test": 6}
    assert only_train["history"][0]["validation_loss"] is None
    assert [note.split(":")[0] for note in only_train["notes"]] == [
        "The validation split is empty",
        "The test split is empty",
        "Test rods were trained on",
        "There are only 6 test rods",
    ]
    only_test = run("test", test=1.0)
    assert only_test["rods"] == {"train": 6, "validation": 0, "test": 6}
    assert (
        only_test["notes"][0]
        == "The train split is empty: the network was trained on the test split."
    )


@pytest.mark.physics
def test_evaluation_of_a_part_is_told_and_the_number_of_threads_put_back(config):
    before = torch.get_num_threads()
    report = train_curvature(replace(config, steps=1, evaluation_rods=3, threads=before + 1))
    assert report["rods"]["test"] == 3
    assert report["notes"][0].startswith("Evaluated on 3 of ")
    assert torch.get_num_threads() == before


def test_what_cannot_be_trained_on_is_refused(config, clips, make_rods):
    with pytest.raises(
        ValueError, match="kind of the dataset must be rod_hang to train on curvature"
    ):
        train_curvature(replace(config, dataset=str(clips.root)))
    nothing = make_rods(rejected=tuple(range(60)))
    with pytest.raises(ValueError, match="has no valid sample to train on"):
        train_curvature(replace(config, dataset=str(nothing.root)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, "steps must be more than 0 and finite, and is 0"),
        ({"batch_size": -1}, "batch_size must be more than 0"),
        ({"noise": 1.0}, "noise must be a share of L"),
        ({"decay": 1.0}, "decay must be between 0 and 1"),
        ({"averaging": 1.0}, "averaging must be from 0"),
        ({"seed": -1}, "seed must be from 0"),
        (
            {"learning_rate": float("nan")},
            "learning_rate must be more than 0 and finite, and is nan",
        ),
    ],
)
def test_a_config_is_checked_where_it_is_built(config, changes, message):
    with pytest.raises(ValueError, match=message):
        replace(config, **changes)
