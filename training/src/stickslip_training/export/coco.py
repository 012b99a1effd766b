"""Segments of cloth in COCO's format [Lin et al. 2014, cocodataset.org/#format-data]."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.version import Split

NO_THINGS = ("background", "floor")
"""Names of the codes of `segmentation` that are not exported."""


def export_coco(reader: DatasetReader, out: Path, *, every: int = 1, split: Split | None = None) -> tuple[int, int]:
    """Write frames as PNG and their segments as annotations.json; return how many images and segments.

    A segment is all that is seen of a thing in a frame, as run lengths of a mask. Images also have the slot and frame
    of the sample, and its parameters.

    Raises:
        ValueError: The dataset has no segmentation.
    """
    from PIL import Image

    if "segmentation" not in reader.arrays or "video" not in reader.arrays:
        raise ValueError("the dataset has no segmentation: its spec must say `ground_truth: [segmentation]`")
    names = reader.arrays["segmentation"].attributes["categories"]
    codes = {code: name for code, name in enumerate(names) if name not in NO_THINGS}
    axes = [name for name in reader.spec.named_axes if name in reader.arrays]
    folder = out / "images"
    folder.mkdir(parents=True, exist_ok=True)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for slot in reader.slots(split).tolist():
        video, segments = (reader.read(name, [slot])[0] for name in ("video", "segmentation"))
        values = {name: reader.label(name)[slot].item() for name in axes}
        labels = {name: known[v] if (known := reader.categories(name)) else v for name, v in values.items()}
        for frame in range(0, len(video), every):
            height, width = segments[frame].shape
            name = f"{slot:06d}-{frame:03d}.png"
            Image.fromarray(video[frame]).save(folder / name)
            image = {"id": len(images) + 1, "file_name": name, "width": width, "height": height}
            images.append(image | {"slot": slot, "frame": frame, **labels})
            for code, segment in _segments(segments[frame], codes):
                annotations.append(
                    {"id": len(annotations) + 1, "image_id": image["id"], "category_id": code, "iscrowd": 0, **segment}
                )
    content = {
        "info": {"description": f"{reader.manifest.dataset}, version {reader.manifest.version}"},
        "images": images,
        "annotations": annotations,
        "categories": [{"id": code, "name": name, "supercategory": "scene"} for code, name in codes.items()],
    }
    (out / "annotations.json").write_text(json.dumps(content), encoding="utf-8")
    return len(images), len(annotations)


def _segments(seen: npt.NDArray[np.uint8], codes: dict[int, str]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the things of a frame, (height, width) of codes: code, mask, area and bounding box."""
    for code in codes:
        mask = seen == code
        if mask.any():
            rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
            left, top = int(columns[0]), int(rows[0])
            box = [left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1]
            yield code, {"segmentation": run_lengths(mask), "area": int(mask.sum()), "bbox": box}


def run_lengths(mask: npt.NDArray[np.bool_]) -> dict[str, Any]:
    """Return a mask (height, width) as COCO's run lengths: column by column, zeros and ones by turns, zeros first."""
    line = np.concatenate([[False], mask.ravel(order="F"), [not mask[-1, -1]]])
    ends = np.flatnonzero(line[1:] != line[:-1])
    return {"size": list(mask.shape), "counts": np.diff(ends, prepend=0).tolist()}
