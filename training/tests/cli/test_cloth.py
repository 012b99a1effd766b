import json

import numpy as np
import pytest
from stickslip_schemas.spec.cameras import load_rig
from stickslip_training.cli import app
from stickslip_training.cli.cloth import NO_ANSWER
from stickslip_training.cloth.clips import read_clips
from stickslip_training.cloth.crop import HEIGHT, WIDTH
from stickslip_training.cloth.familiarity import ALARMS
from stickslip_training.cloth.model import WEIGHTS
from stickslip_training.cloth.scope import package_scope
from stickslip_training.data.reader import DatasetReader
from typer.testing import CliRunner

pytestmark = pytest.mark.physics

runner = CliRunner(env={"COLUMNS": "120", "NO_COLOR": "1"})
AXES = {
    "material": ["gray-interlock", "11oz-black-denim"],
    "mu": [0.1, 0.4],
    "texture": "plaid",
    "viewpoint": "left",
}


@pytest.fixture(scope="module")
def packed(request):
    return request.path.parent.parent / "cloth" / "runs.npz"


@pytest.fixture(scope="module")
def clips(make_clips):
    written = make_clips(
        rejected=(1,), axes=AXES, frames=30, splits={"train": 0.0, "validation": 0.0, "test": 1.0}
    )
    written.edit_manifest(cameras=load_rig("drag"))
    return written


@pytest.mark.physics
def test_train_and_resume(packed, tmp_path):
    with np.load(packed) as file:
        arrays = dict(file)
    for name, slots_of_split in (("train", slice(0, None, 12)), ("validation", slice(1, None, 48))):
        part = {
            "differences": arrays["differences"][:, slots_of_split],
            "about": arrays["about"][slots_of_split],
        }
        np.savez(tmp_path / f"{name}.npz", **arrays | part)
    alone = [
        "cloth",
        "train",
        str(tmp_path / "train.npz"),
        "--out",
        str(tmp_path / "run"),
        "--threads",
        "1",
    ]
    refused = runner.invoke(app, alone)
    assert refused.exit_code == 1
    assert "validation must be a packed file of simulations" in " ".join(refused.stderr.split())
    run = [*alone, "--validation", str(tmp_path / "validation.npz")]
    trained = runner.invoke(app, [*run, "--steps", "2"])
    assert trained.exit_code == 0, trained.output
    assert "step 2 of 2: loss" in trained.output
    card = json.loads((tmp_path / "run" / "report.json").read_text())
    assert card["training_runs"] > card["validation_runs"] > 0
    again = runner.invoke(app, [*run, "--steps", "2", "--seed", "1", "--resume"])
    assert again.exit_code == 1
    assert "seed must be that of the run that is resumed, 0, and is 1" in again.stderr


def test_predictions_of_a_dataset_are_a_list(clips):
    predict = ["cloth", "predict", str(clips.root), "--model", str(WEIGHTS)]
    result = runner.invoke(app, [*predict, "--json"])
    assert result.exit_code == NO_ANSWER, result.output
    answers = json.loads(result.stdout)
    assert [answer["slot"] for answer in answers] == [0, 2, 3]
    for answer in answers:
        assert set(answer) == {"slot", "material", "mu", "familiarity", "no_answer"}
        assert sum(answer["material"].values()) == pytest.approx(1.0, abs=1e-4)
        # Pictures of noise: there is no cloth in them.
        assert answer["mu"] is None
        assert answer["no_answer"]
        assert answer["familiarity"] < ALARMS
    table = runner.invoke(app, predict)
    assert "no answer" in table.output
    narrow = CliRunner(env={"COLUMNS": "80", "NO_COLOR": "1"}).invoke(app, predict)
    assert "familiarity" in narrow.stdout
    assert max(map(len, narrow.stdout.splitlines())) <= 80


def test_the_clips_of_a_dataset_as_a_network_sees_them(clips):
    with DatasetReader(clips.root) as reader:
        crops, slots = read_clips(reader, "test", ("11oz-black-denim",))
    assert slots.tolist() == [0, 2, 3]
    assert crops.crops.shape == (3, 6, HEIGHT, WIDTH)
    assert 0 <= crops.crops.min() <= crops.crops.max() <= 1
    assert crops.material.tolist() == [-1, 0, 0]  # the other fabric is not known
    assert crops.mu.tolist() == [0.1, 0.1, 0.4]


def test_what_cannot_be_measured_is_refused(clips, rods, make_clips):
    def refused(*command):
        result = runner.invoke(app, ["cloth", *command])
        assert result.exit_code == 1
        return result.stderr

    assert "kind of the dataset must be cloth_drag to measure friction: it is rod_hang" in refused(
        "predict", str(rods.root), "--model", str(WEIGHTS)
    )
    short = make_clips(frames=2)
    assert (
        "a clip must have a frame within 0.06 s of 25.00 s after the start; its nearest of 2 is"
        in refused("predict", str(short.root), "--model", str(WEIGHTS))
    )
    assert "split must be one of train, validation, test, and is all" in refused(
        "predict", str(clips.root), "--model", str(WEIGHTS), "--split", "all"
    )
    assert "splits train and validation must have simulations" in refused(
        "train", str(clips.root), "--out", str(clips.root / "out")
    )


def test_a_dataset_outside_of_the_weights_is_refused(make_clips):
    coarse = make_clips(
        axes=AXES, frames=30, splits={"train": 0.0, "validation": 0.0, "test": 1.0}, preset="fast"
    )
    result = runner.invoke(app, ["cloth", "predict", str(coarse.root)])
    assert result.exit_code == 1
    assert result.stdout == ""
    message = " ".join(result.stderr.split())
    mesh = coarse.spec.mesh
    assert (
        f"know: mesh {mesh} (known: 41 and finer), preset fast (known: certified, fine)" in message
    )
    assert "examples/friction-cloth.yaml" in message
    assert "--model" in message


def test_the_scope_names_materials_and_friction_that_are_unknown(clips):
    scope = package_scope(("gray-interlock", "11oz-black-denim"))
    known = {"mesh": 41, "preset": "certified", "quality": "draft"}
    spec = clips.spec.model_copy(update=known)
    assert scope.outside(spec, {"gray-interlock"}, 1.6) == []
    scope.check(spec, {"gray-interlock"}, 1.6)
    assert scope.outside(spec, {"gray-interlock", "felt", "canvas"}, 2.0) == [
        "material canvas, felt (known: gray-interlock, 11oz-black-denim)",
        "mu 2 (known: 0 to 1.6)",
    ]
    # The renderer of other qualities was in no test of the network.
    untested = spec.model_copy(update={"quality": "high"})
    assert scope.outside(untested, set(), 0.0) == ["quality high (known: draft, standard)"]
