"""COCO: masks and boxes of all things in all frames of clips [Lin et al. 2014].

An image is a frame of a clip, and an annotation is all that it shows of one thing: its mask as
run lengths, the box around it and its area. Masks are the ground truth `segmentation`, and they
are exact. Files are written as their samples are read.
"""

import json
import shutil
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

from stickslip_schemas.format.pictures import png

from stickslip_training.export.formats import Content, OnBytes, sample_labels
from stickslip_training.export.masks import SEGMENTATION, annotations, categories, image
from stickslip_training.export.strict_json import strict_json

NEEDED = ("video", SEGMENTATION)


def write(content: Content, directory: Path, on_bytes: OnBytes) -> None:
    """Write `annotations/instances_SPLIT.json`, `images/SPLIT/SLOT-FRAME.png` and `labels.jsonl`.

    Raises ValueError if the dataset has no clips or no segmentation.
    """
    by_name = {array.name: array for array in content.arrays}
    missing = [name for name in NEEDED if name not in by_name]
    if missing:
        raise ValueError(
            f"COCO needs the arrays {' and '.join(NEEDED)}, and {' and '.join(missing)} "
            f"of {content.name} is not in this part: a spec asks for masks with "
            "`ground_truth: [segmentation]`"
        )
    names = list(by_name[SEGMENTATION].attributes["categories"])
    (directory / "annotations").mkdir()
    for split, slots in _by_split(content).items():
        (directory / "images" / split).mkdir(parents=True)
        with _Instances(directory, split, names) as instances:
            for slot in slots:
                instances.add(content, slot)
                on_bytes(content.sample_bytes)
    with (directory / "labels.jsonl").open("x", encoding="utf-8") as lines:
        for slot in content.slots.tolist():
            lines.write(strict_json({"slot": slot} | sample_labels(content, slot)) + "\n")


def _by_split(content: Content) -> dict[str, list[int]]:
    """Return the slots of each split that has any."""
    slots: dict[str, list[int]] = {}
    for split, _, _, batch in content.parts():
        slots.setdefault(split, []).extend(batch.tolist())
    return slots


class _Instances:
    """The images of a split and the file of their annotations, which grows with each sample."""

    def __init__(self, directory: Path, split: str, names: list[str]) -> None:
        self._folder = directory / "images" / split
        self._path = directory / "annotations" / f"instances_{split}.json"
        # Two lists grow at once, so the second one has a file of its own until the end.
        self._rest = self._path.with_suffix(".annotations")
        self._names = names
        self._image_count = 0
        self._annotation_count = 0

    def __enter__(self) -> "_Instances":
        with ExitStack() as files:
            self._images = files.enter_context(self._path.open("x+", encoding="utf-8"))
            self._annotations = files.enter_context(self._rest.open("x+", encoding="utf-8"))
            self._files = files.pop_all()
        self._images.write('{"images": [')
        return self

    def __exit__(self, *failure: object) -> None:
        with self._files:
            if failure[0] is None:
                self._images.write('],\n"annotations": [')
                self._annotations.seek(0)
                shutil.copyfileobj(self._annotations, self._images)
                listed = json.dumps(categories(self._names))
                self._images.write(f'],\n"categories": {listed}}}\n')
        self._rest.unlink()

    def add(self, content: Content, slot: int) -> None:
        """Write the images of a sample, and its annotations."""
        video = content.picture("video", slot)
        segments = content.picture(SEGMENTATION, slot)
        for frame, (picture, codes) in enumerate(zip(video, segments, strict=True)):
            name = f"{slot:08d}-{frame:04d}.png"
            (self._folder / name).write_bytes(png(picture))
            self._image_count += 1
            height, width = codes.shape
            entry = image(self._image_count, name, width, height)
            _append(self._images, entry | {"slot": slot, "frame": frame}, self._image_count)
            for annotation in annotations(codes, self._names):
                self._annotation_count += 1
                numbers = {"id": self._annotation_count, "image_id": self._image_count}
                _append(self._annotations, numbers | annotation, self._annotation_count)


def _append(file: IO[str], item: Mapping[str, Any], number: int) -> None:
    """Write an item of a list, the first of which has the number 1."""
    file.write("\n" if number == 1 else ",\n")
    file.write(json.dumps(item, separators=(",", ":")))
