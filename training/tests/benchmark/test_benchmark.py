import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from stickslip_schemas.base import canonical_json, sha256
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.arrays import SPLITS
from stickslip_testing.samples import samples
from stickslip_testing.sets import frozen
from stickslip_training.benchmark import clip_sets, sets
from stickslip_training.benchmark.sets import (
    enter,
    load_set,
    read_record,
    set_names,
    table,
    with_tables,
)
from stickslip_training.benchmark.tasks import NOISES, RodTask
from stickslip_training.cli import app
from stickslip_training.data.reader import DatasetReader
from stickslip_training.rods.evaluation import bending
from typer.testing import CliRunner

runner = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"})
ROOT = Path(__file__).parents[3]
RECORDS = sorted((ROOT / "benchmarks" / "results").glob("*/*.json"))


def add_set(folder, name, dataset, split="test"):
    spec = json.loads(dataset.spec.model_dump_json(exclude_defaults=True)) | {
        "kind": dataset.spec.kind
    }
    with DatasetReader(dataset.root) as reader:
        document, control_values = frozen(name, "a set to test with", spec, split, reader)
    (folder / f"{name}.json").write_bytes(document)
    (folder / f"{name}.npz").write_bytes(control_values)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of sets of its own."""
    path = tmp_path / "sets"
    path.mkdir()
    monkeypatch.setattr(sets, "SETS", path)
    return path


@pytest.fixture
def rod_set(folder, rods):
    add_set(folder, "some-rods", rods)
    return rods


def checked(name, root):
    with DatasetReader(root) as reader:
        return load_set(name).check(reader)


def rod_answers(dataset, factor=1.0, gamma=None):
    with DatasetReader(dataset.root) as reader:
        slots = reader.slots("test")
        truth, weights = bending(reader.read("curvature", slots)), reader.label("gamma")[slots]
    return [
        {"slot": slot, "noise": noise, "bending": (factor * row).tolist()}
        | ({} if gamma is None else {"gamma": gamma * weight})
        for noise in NOISES
        for slot, row, weight in zip(slots.tolist(), truth, weights.tolist(), strict=True)
    ]


# --- which dataset is the set
# ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", set_names())
def test_the_labels_of_a_committed_set_follow_from_its_spec(name):
    chosen = load_set(name)
    builds = Builds(**{stage: sha256(stage.encode()) for stage in Builds.model_fields})
    planned = [
        sample
        for sample in samples(chosen.parsed_spec, builds)
        if chosen.split in (None, SPLITS[sample.split])
    ]
    always = {"lighting": "drawn"} if chosen.spec["kind"] == "cloth_drag" else {}
    labels = [{"slot": sample.slot, **sample.labels, **always} for sample in planned]
    assert sha256(canonical_json(labels).encode()) == chosen.labels
    assert set(chosen.control_values) == set(chosen.task.tolerances)
    assert all(
        len(values) in (len(planned), len(NOISES)) for values in chosen.control_values.values()
    )
    assert len(chosen.published[0]) == 64


def test_a_set_that_was_made_again_is_known(rod_set, tmp_path):
    slots, making = checked("some-rods", rod_set.root)
    assert making == "published"
    assert (
        slots.tolist()
        == np.flatnonzero((rod_set.arrays["split"] == 2) & rod_set.arrays["valid"]).tolist()
    )
    again = rod_set.copy(tmp_path / "again")
    again.edit_manifest(certificate=sha256(b"another build"))
    assert checked("some-rods", again.root)[1] == "remade"


def test_another_dataset_is_refused(rod_set, make_rods, monkeypatch):
    with pytest.raises(
        ValueError, match="must be the test set some-rods, and is not: its spec is another one"
    ):
        checked("some-rods", make_rods(seed=3, rejected=(5, 59)).root)
    tested = int(checked("some-rods", rod_set.root)[0][0])
    with pytest.raises(ValueError, match=r"the labels of its .* samples to answer have SHA-256"):
        checked("some-rods", make_rods(rejected=(5, 59, tested)).root)
    # Another machine's rods, further off than rounding.
    read = DatasetReader.read
    monkeypatch.setattr(
        DatasetReader,
        "read",
        lambda self, name, slots: read(self, name, slots) * np.float32(1.0003),
    )
    with pytest.raises(
        ValueError,
        match=r"centerline differs by up to .*, and 1e-05 is allowed. .* take a published",
    ):
        checked("some-rods", rod_set.root)


@pytest.mark.physics
def test_clips_that_look_different_are_refused(folder, make_clips, monkeypatch):
    clips = make_clips(frames=4)
    add_set(folder, "some-clips", clips, None)
    assert checked("some-clips", clips.root)[1] == "published"
    read = DatasetReader.read

    def brighter(self, name, slots):
        frames = read(self, name, slots)
        frames[:, 2, 14:28, 28:42] += 2  # one block of one frame
        return frames

    monkeypatch.setattr(DatasetReader, "read", brighter)
    with pytest.raises(ValueError, match=r"frames differs by up to 2, and 1.5 is allowed"):
        checked("some-clips", clips.root)


def test_an_unknown_set_is_named(folder, rods):
    with pytest.raises(ValueError, match=r"the test set must be one of .*, and is rods-9"):
        load_set("rods-9")


# --- scores
# --------------------------------------------------------------------------------------------------


def test_scores_of_known_answers_about_rods(rod_set, tmp_path):
    answers = rod_answers(rod_set, 1.1, 0.8)
    answers[0]["bending"] = None
    (tmp_path / "answers.json").write_text(json.dumps(answers))
    record = enter(
        "some-rods",
        tmp_path / "answers.json",
        rod_set.root,
        method="m",
        by="b",
        trained_on="nothing",
    )
    assert (record.making, record.predictions) == (
        "published",
        sha256((tmp_path / "answers.json").read_bytes()),
    )
    for noise in ("0.001", "0.005", "0.01"):
        scores = record.scores[noise]
        assert scores["rods"] == len(answers) // 3
        assert scores["bending"]["median"]["value"] == pytest.approx(0.1, abs=1e-5)
        assert scores["gamma"]["median"]["value"] == pytest.approx(0.2, abs=1e-5)
    assert [record.scores[noise]["failed"] for noise in ("0.001", "0.005", "0.01")] == [1, 0, 0]
    assert (
        record.scores["0.001"]["bending"]["p95"] is None
    )  # a rod without an answer is infinitely wrong
    assert record.scores["0.005"]["bending"]["p95"]["value"] == pytest.approx(0.1, abs=1e-5)
    row = RodTask().row(record.scores)
    assert row == ("10 %; - (1 fail)", "10 %; 10 %", "10 %; 10 %", "20 %; 20 %")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop(), "must be answered at every noise, and 1 are not, .* at 0.01 first"),
        (lambda a: a.append(a[0]), "is answered twice at noise 0.001"),
        (lambda a: a[0].update(noise=0.002), "slot and noise of answer 0 must be of the test set"),
        (
            lambda a: a[0].update(bending=[1.0]),
            "bending of answer 0 must be 150 finite numbers of 0 or more, or null",
        ),
        (
            lambda a: a[1]["bending"].__setitem__(3, -1.0),
            "bending of answer 1 must be 150 finite numbers",
        ),
        (
            lambda a: a[1]["bending"].__setitem__(3, float("nan")),
            "bending of answer 1 must be 150 finite numbers",
        ),
        (
            lambda a: a[2].update(gamma=-3.0),
            "gamma of answer 2 must be more than 0 and finite, and is -3.0",
        ),
        (lambda a: a[2].pop("bending"), "answer 2 must have slot, noise and bending"),
    ],
)
def test_answers_about_rods_are_checked(rod_set, change, message):
    answers = rod_answers(rod_set)
    change(answers)
    with DatasetReader(rod_set.root) as reader, pytest.raises(ValueError, match=message):
        RodTask().score(reader, reader.slots("test"), answers)


def test_what_a_method_is_given_is_the_noisy_centreline(rod_set, tmp_path):
    lines = []
    for out, secret in (("a.npz", "mine"), ("b.npz", "mine"), ("c.npz", "other")):
        command = [
            "benchmark",
            "inputs",
            "some-rods",
            str(rod_set.root),
            "--out",
            str(tmp_path / out),
        ]
        done = runner.invoke(app, [*command, "--secret", str(tmp_path / secret)])
        assert done.exit_code == 0, done.output
        with np.load(tmp_path / out) as file:
            assert set(file.files) == {"slot", "noise", "centerline"}
            off = file["centerline"] - rod_set.arrays["centerline"][file["slot"]]
        assert off.std(axis=(1, 2, 3)) == pytest.approx(np.array(NOISES), rel=0.05)
        lines.append(off)
    # The noise is that of the secret, which is new and random where there was none.
    assert np.array_equal(lines[0], lines[1])
    assert abs(np.corrcoef(lines[0].ravel(), lines[2].ravel())[0, 1]) < 0.05
    assert (tmp_path / "mine").read_bytes() != (tmp_path / "other").read_bytes()


def test_scores_of_known_answers_about_clips(folder, clips, tmp_path):
    add_set(folder, "some-clips", clips, None)
    with DatasetReader(clips.root) as reader:
        labels = load_set("some-clips").task.labels(reader, reader.slots())
    assert len(labels) == 10
    answers = [
        {
            "slot": label["slot"],
            "material": {label["material"]: 1.0},
            "mu": {"low": 0.0, "high": 1.0, "median": label["mu"] + 0.3 * (label["mu"] == 0.4)},
        }
        for label in labels
    ]
    (tmp_path / "answers.json").write_text(json.dumps(answers))
    done = runner.invoke(
        app, ["benchmark", "score", "some-clips", str(tmp_path / "answers.json"), str(clips.root)]
    )
    assert done.exit_code == 0, done.output
    cells = [cell.strip() for cell in done.stdout.splitlines()[-1].split("|")]
    assert cells[3:11] == ["1.000", "50% / 50%", "100%", "100%", "0.000", "0.300", "", ""]
    with (
        pytest.raises(ValueError, match="a method is given the clips themselves"),
        DatasetReader(clips.root) as reader,
    ):
        load_set("some-clips").task.inputs(reader, reader.slots(), b"")


# --- the command and the table
# --------------------------------------------------------------------------------


def test_an_entry_from_spec_to_table(rod_set, tmp_path):
    printed = runner.invoke(app, ["benchmark", "spec", "some-rods"])
    assert json.loads(printed.stdout)["kind"] == "rod_hang"
    assert "a set to test with" in runner.invoke(app, ["benchmark", "list"]).stdout
    result = runner.invoke(app, ["benchmark", "check", "some-rods", str(rod_set.root)])
    assert "is some-rods, published: " in result.stdout
    records = []
    for method, factor in (("worse", 1.2), ("better", 1.05)):
        (tmp_path / "answers.json").write_text(json.dumps(rod_answers(rod_set, factor)))
        records.append(tmp_path / f"{method}.json")
        command = [
            "benchmark",
            "score",
            "some-rods",
            str(tmp_path / "answers.json"),
            str(rod_set.root),
        ]
        predicted = [
            "--method",
            method,
            "--by",
            "us",
            "--trained-on",
            "nothing",
            "--record",
            str(records[-1]),
        ]
        done = runner.invoke(app, [*command, *predicted])
        assert done.exit_code == 0, done.output
        first = records[-1].read_bytes()
        assert runner.invoke(app, [*command, *predicted]).exit_code == 0
        assert records[-1].read_bytes() == first  # anybody can check a record
    printed = runner.invoke(app, ["benchmark", "table", *map(str, records)])
    assert printed.stdout.index("better") < printed.stdout.index("worse")
    page = tmp_path / "page.md"
    page.write_text("# Results\n\n<!-- results of some-rods -->\nold\n<!-- end -->\n\nAfter.\n")
    assert (
        runner.invoke(
            app, ["benchmark", "table", *map(str, records), "--page", str(page)]
        ).exit_code
        == 0
    )
    assert "old" not in page.read_text()
    assert (
        page.read_text().endswith("| remade |\n<!-- end -->\n\nAfter.\n")
        or "| published |" in page.read_text()
    )
    assert asdict(read_record(records[0]))["method"] == "worse"
    refused = runner.invoke(app, ["benchmark", "table", str(tmp_path / "answers.json")])
    assert refused.exit_code == 1
    assert "must be a record of" in refused.stderr
    with pytest.raises(
        ValueError, match="must have a place `<!-- results of NAME -->` for some-rods"
    ):
        with_tables("# Nothing\n", [read_record(records[0])])


def test_the_page_shows_the_committed_records():
    records = [read_record(path) for path in RECORDS]
    page = (ROOT / "docs" / "benchmark.md").read_text()
    again = (
        "run: stickslip-train benchmark table benchmarks/results/*/*.json --page docs/benchmark.md"
    )
    assert with_tables(page, records) == page, again
    assert {record.set for record in records} == set(set_names())
    for path, record in zip(RECORDS, records, strict=True):
        assert path.parent.name == record.set
        assert record.making == "published"
        assert record.manifest in load_set(record.set).published
        assert record.method in table(record.set, records)


# --- sets of clips
# --------------------------------------------------------------------------------------------------


def clip_rows(floor, count=2):
    constant = {"finish": None, "factors": {"density": 1.0}, "vertices": 41, "preset": "certified"}
    return [
        {"run": run, "material": "tango", "mu": 0.1 * run, "seed": run, "self_friction": 0.5}
        | {"viewpoint": "left", "texture": "dots", "substrate": floor}
        | constant
        | {"cpu_s": float(run), "build": "of this machine"}
        for run in range(count)
    ]


def write_clips_of(folder, floor, rows):
    folder.mkdir(exist_ok=True)
    np.savez(folder / f"{floor}.npz", about=np.array([json.dumps(row) for row in rows]))


@pytest.fixture
def clip_set(tmp_path, monkeypatch):
    sets_folder = tmp_path / "clip-sets"
    sets_folder.mkdir()
    monkeypatch.setattr(clip_sets, "CLIP_SETS", sets_folder)
    labels = [
        clip_sets.labels_of(floor, row) for floor in ("matt", "oak") for row in clip_rows(floor)
    ]
    document = {"about": "clips to test with", "runs": {}, "floors": {"matt": {}, "oak": {}}}
    document |= {"clips": 4, "labels": clip_sets.digest_of(labels), "published": {}}
    (sets_folder / "clips-0.json").write_text(json.dumps(document))
    return tmp_path / "made"


def test_clips_that_were_made_elsewhere_are_the_set(clip_set):
    for floor in ("matt", "oak"):
        rows = [row | {"build": "another machine"} for row in clip_rows(floor)]
        write_clips_of(clip_set, floor, rows)
    result = runner.invoke(app, ["benchmark", "check", "clips-0", str(clip_set)])
    assert result.exit_code == 0, result.output
    assert "is clips-0: 4 clips to answer" in result.stdout


def test_other_clips_are_refused(clip_set):
    write_clips_of(clip_set, "matt", clip_rows("matt"))
    missing = runner.invoke(app, ["benchmark", "check", "clips-0", str(clip_set)])
    assert missing.exit_code == 1
    assert "must hold oak.npz to be the test set clips-0, and does not" in missing.stderr
    changed = clip_rows("oak")
    changed[1]["mu"] += 1e-6
    write_clips_of(clip_set, "oak", changed)
    other = runner.invoke(app, ["benchmark", "check", "clips-0", str(clip_set)])
    assert other.exit_code == 1
    assert "the labels of its 4 clips have SHA-256" in other.stderr


def test_the_set_that_chose_the_weights_is_another_one():
    tested, chose = map(clip_sets.load_clip_set, ("cloth-2", "cloth-2-validation"))
    assert tested.clips == chose.clips == 600
    assert tested.labels != chose.labels
    assert tested.runs["seed"] != chose.runs["seed"]
    assert tested.published == {"as rendered": 0.041, "all": 0.058}
    with pytest.raises(ValueError, match="must be one of cloth-2, cloth-2-validation, and is x"):
        clip_sets.load_clip_set("x")
