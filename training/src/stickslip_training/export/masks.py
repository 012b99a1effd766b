"""Masks of things in frames, as COCO has them [Lin et al. 2014].

A mask is the lengths of its runs of 0 and 1 down the columns; `pycocotools` reads them as they are.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from stickslip_training.arrays import Array

NOTHING = "background"
"""Name of the code that is no thing."""


SEGMENTATION = "segmentation"
"""Array with the code of the thing that each pixel shows."""


def categories(names: list[str]) -> list[dict[str, Any]]:
    """Return the categories of the names of codes; an id is a code."""
    return [{"id": code, "name": name} for code, name in enumerate(names) if name != NOTHING]


def annotations(codes: Array, names: list[str]) -> Iterator[dict[str, Any]]:
    """Yield the annotation of each thing in a frame (height, width) of codes, without ids."""
    for category in categories(names):
        mask = codes == category["id"]
        if mask.any():
            yield {"category_id": category["id"], **_shape_of(mask)}


def _shape_of(mask: Array) -> dict[str, Any]:
    """Return mask, box and area of a thing, as COCO has them."""
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    left, top = int(columns[0]), int(rows[0])
    return {
        "segmentation": {"size": list(mask.shape), "counts": run_lengths(mask)},
        "bbox": [left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1],
        "area": int(np.count_nonzero(mask)),
        "iscrowd": 0,
    }


def run_lengths(mask: Array) -> list[int]:
    """Return the lengths of runs of 0, 1, 0, ... down the columns of a mask (height, width).

    The first run is empty if the first pixel is 1.
    """
    pixels = mask.ravel(order="F")
    ends = np.flatnonzero(pixels[1:] != pixels[:-1]) + 1
    bounds = [0, *ends.tolist(), pixels.size]
    lengths = np.diff(bounds).tolist()
    return [0, *lengths] if pixels[0] else lengths


def document(frames: Array, names: list[str], file_name: str) -> dict[str, Any]:
    """Return the COCO document of the frames (n, height, width) of codes of one sample.

    `file_name` is that of an image with `{frame}` for its number.
    """
    height, width = frames.shape[1:]
    images = []
    entries: list[dict[str, Any]] = []
    for number, codes in enumerate(frames):
        images.append(image(number, file_name.format(frame=number), width, height))
        for annotation in annotations(codes, names):
            entries.append({"id": len(entries) + 1, "image_id": number, **annotation})
    return {"images": images, "annotations": entries, "categories": categories(names)}


def image(number: int, file_name: str, width: int, height: int) -> dict[str, Any]:
    """Return the entry of an image of COCO."""
    return {"id": number, "file_name": file_name, "width": width, "height": height}
