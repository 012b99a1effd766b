"""Masks and boxes are read by pycocotools, and are those of the segmentation."""

import json
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from stickslip_training.cli import app
from stickslip_training.data.reader import DatasetReader
from stickslip_training.export import coco, masks
from stickslip_training.export.formats import Content
from typer.testing import CliRunner

run = CliRunner().invoke
pytestmark = pytest.mark.filterwarnings("ignore")  # of pycocotools with NumPy 2
THINGS = {1: "floor", 2: "cloth", 3: "prop"}


def _sizes(sized_clips: Any) -> list[tuple[int, int]]:
    return [tuple(size) for size in sized_clips.arrays["picture_size"].tolist()]


def test_masks_are_read_back_by_pycocotools(sized_clips: Any, tmp_path: Path) -> None:
    pycocotools = pytest.importorskip("pycocotools.coco", reason="make setup-dev")
    target = tmp_path / "out"
    done = run(app, ["export", str(sized_clips.root), "--coco", str(target)])
    assert done.exit_code == 0, done.output
    categories = set()
    for path in sorted((target / "annotations").glob("instances_*.json")):
        split = path.stem.removeprefix("instances_")
        index = pycocotools.COCO(str(path))
        assert {entry["id"]: entry["name"] for entry in index.loadCats(index.getCatIds())} == THINGS
        for image in index.loadImgs(index.getImgIds()):
            slot, frame = image["slot"], image["frame"]
            categories.add((slot, frame))
            width, height = _sizes(sized_clips)[slot]
            assert (image["width"], image["height"]) == (width, height)
            codes = sized_clips.arrays["segmentation"][slot, frame, :height, :width]
            entries = index.loadAnns(index.getAnnIds(image["id"]))
            assert {entry["category_id"] for entry in entries} == set(THINGS)
            for entry in entries:
                mask = index.annToMask(entry).astype(bool)
                assert np.array_equal(mask, codes == entry["category_id"])
                assert entry["area"] == mask.sum()
                from pycocotools import mask as library

                assert library.toBbox(index.annToRLE(entry)).tolist() == entry["bbox"]
            with Image.open(target / "images" / split / image["file_name"]) as picture:
                pixels = np.asarray(picture)
            assert np.array_equal(pixels, sized_clips.arrays["video"][slot, frame, :height, :width])
    valid = np.flatnonzero(sized_clips.arrays["valid"])
    frames = sized_clips.arrays["video"].shape[1]
    assert categories == {(slot, frame) for slot in valid.tolist() for frame in range(frames)}
    labels = [json.loads(line) for line in (target / "labels.jsonl").read_text().splitlines()]
    assert [label["slot"] for label in labels] == valid.tolist()
    assert not list((target / "annotations").glob("*.annotations"))


def test_a_sample_of_webdataset_has_its_masks(sized_clips: Any, tmp_path: Path) -> None:
    pycocotools = pytest.importorskip("pycocotools.coco", reason="make setup-dev")
    target = tmp_path / "out"
    done = run(app, ["export", str(sized_clips.root), "--webdataset", str(target)])
    assert done.exit_code == 0, done.output
    checked = 0
    for path in target.glob("*.tar"):
        with tarfile.open(path) as tar:
            for member in tar:
                if not member.name.endswith(".coco.json"):
                    continue
                slot = int(member.name.split(".")[0])
                file = tar.extractfile(member)
                assert file is not None
                index = pycocotools.COCO()
                index.dataset = json.load(file)
                index.createIndex()
                width, height = _sizes(sized_clips)[slot]
                codes = sized_clips.arrays["segmentation"][slot, :, :height, :width]
                for entry in index.loadAnns(index.getAnnIds()):
                    wanted = codes[entry["image_id"]] == entry["category_id"]
                    assert np.array_equal(index.annToMask(entry).astype(bool), wanted)
                    checked += 1
    assert checked == 3 * sized_clips.arrays["video"].shape[1] * sized_clips.arrays["valid"].sum()


@pytest.mark.parametrize(
    "mask", [[[0, 0], [0, 0]], [[1, 1], [1, 1]], [[1, 0], [0, 1]], [[0, 1], [0, 0]]]
)
def test_run_lengths_add_up_to_the_mask(mask: Any) -> None:
    lengths = masks.run_lengths(np.array(mask, dtype=bool))
    pixels = np.repeat(np.arange(len(lengths)) % 2, lengths)
    assert pixels.tolist() == np.array(mask).T.ravel().tolist()
    assert all(lengths[1:])


def test_a_dataset_without_masks_is_refused_with_the_remedy(clips: Any, tmp_path: Path) -> None:
    done = run(app, ["export", str(clips.root), "--coco", str(tmp_path / "out")])
    assert done.exit_code != 0
    assert "segmentation" in done.output
    assert "ground_truth: [segmentation]" in " ".join(done.output.split())
    assert not (tmp_path / "out").exists()


def test_an_export_that_fails_leaves_nothing(
    sized_clips: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> bytes:
        raise OSError("the disk is full")

    monkeypatch.setattr(coco, "png", broken)
    done = run(app, ["export", str(sized_clips.root), "--coco", str(tmp_path / "out")])
    assert done.exit_code != 0
    assert not list(tmp_path.iterdir())


def test_a_picture_is_cut_from_its_frame(sized_clips: Any) -> None:
    from stickslip_schemas.format.selection import Selection

    with DatasetReader(str(sized_clips.root)) as reader:
        content = Content(reader, Selection())
        assert content.picture("video", 0).shape[1:] == (90, 66, 3)
        slot = next(slot for slot, size in enumerate(_sizes(sized_clips)) if size == (120, 66))
        assert content.picture("depth", slot).shape[1:] == (66, 120)
