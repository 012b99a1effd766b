"""What is exported in COCO's format is what the dataset has."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from stickslip_schemas.kinds.cloth.spec import SEGMENTS
from stickslip_training.data.reader import DatasetReader
from stickslip_training.export.coco import export_coco, run_lengths


def test_run_lengths_give_the_mask_back() -> None:
    random = np.random.Generator(np.random.PCG64(0))
    for share in (0.0, 0.3, 1.0):
        mask = random.random((5, 7)) < share
        coded = run_lengths(mask)
        values = np.arange(len(coded["counts"])) % 2 == 1
        found = np.repeat(values, coded["counts"]).reshape(mask.shape, order="F")
        assert coded["size"] == [5, 7]
        assert np.array_equal(found, mask)


@pytest.mark.physics
def test_frames_and_segments_are_written(make_clips: Callable[..., Any], tmp_path: Path) -> None:
    made = make_clips(ground_truth=["segmentation"], rejected=(3,))
    with DatasetReader(made.root) as reader:
        assert export_coco(reader, tmp_path / "coco") == (22, 44)
        assert export_coco(reader, tmp_path / "first", every=2) == (11, 22)
    content = json.loads((tmp_path / "coco" / "annotations.json").read_text())
    names = {category["id"]: category["name"] for category in content["categories"]}
    assert list(names.values()) == ["cloth", "prop"]
    image = content["images"][7]
    assert (image["slot"], image["frame"], image["mu"]) == (4, 1, made.arrays["mu"][4])
    with Image.open(tmp_path / "coco" / "images" / image["file_name"]) as picture:
        assert np.array_equal(np.asarray(picture), made.arrays["video"][4, 1])
    own = [entry for entry in content["annotations"] if entry["image_id"] == image["id"]]
    assert [names[entry["category_id"]] for entry in own] == ["cloth", "prop"]
    for entry in own:
        mask = made.arrays["segmentation"][4, 1] == SEGMENTS.index(names[entry["category_id"]])
        rows, columns = np.nonzero(mask)
        assert entry["segmentation"] == run_lengths(mask)
        assert entry["area"] == mask.sum()
        left, top, width, height = entry["bbox"]
        assert (left, left + width - 1) == (columns.min(), columns.max())
        assert (top, top + height - 1) == (rows.min(), rows.max())


def test_a_dataset_without_segmentation_is_refused(make_clips: Callable[..., Any], tmp_path: Path) -> None:
    with DatasetReader(make_clips().root) as reader, pytest.raises(ValueError, match=r"ground_truth: \[segmentation\]"):
        export_coco(reader, tmp_path / "coco")
