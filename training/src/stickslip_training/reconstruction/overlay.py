"""Pictures of a reconstruction over the views that it came from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

if TYPE_CHECKING:
    from PIL import Image

Color = tuple[int, int, int]

FOUND: Color = (0, 255, 255)
TRUE: Color = (255, 60, 255)
LEAST_HEIGHT = 600  # [px]: smaller pictures are enlarged by a whole factor


def import_pillow() -> Any:
    """Return PIL.Image, or say how to get it."""
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise ImportError("Pillow is missing: pip install 'stickslip-training[images]'") from error
    return Image


def overlay(
    views: Sequence[npt.NDArray[np.uint8]],
    cameras: Sequence[Camera],
    curves: Sequence[tuple[npt.NDArray[np.float64], Color]],
) -> Image.Image:
    """Return the views (y, x, rgb) side by side, with curves (n, 3) [camera unit] drawn over them, last on top."""
    module = import_pillow()
    from PIL import ImageDraw

    panels = []
    for pixels, camera in zip(views, cameras, strict=True):
        factor = max(1, round(LEAST_HEIGHT / camera.height))
        panel = module.fromarray(np.asarray(pixels)).convert("RGB")
        panel = panel.resize((camera.width * factor, camera.height * factor), module.Resampling.NEAREST)
        pen = ImageDraw.Draw(panel)
        for points, color in curves:
            line = (camera.project(points)[0] + 0.5) * factor - 0.5
            pen.line([tuple(point) for point in line.tolist()], fill=color, width=max(1, camera.height // 800))
        panels.append(panel)
    sheet = module.new("RGB", (sum(panel.width for panel in panels), max(panel.height for panel in panels)))
    left = 0
    for panel in panels:
        sheet.paste(panel, (left, 0))
        left += panel.width
    return sheet  # type: ignore[no-any-return]


def save_overlay(
    path: Path,
    views: Sequence[npt.NDArray[np.uint8]],
    cameras: Sequence[Camera],
    found: npt.NDArray[np.float64],
    true: npt.NDArray[np.float64] | None = None,
) -> None:
    """Write a PNG with the reconstructed centreline and, below it, the true one if it is known."""
    curves = [(found, FOUND)] if true is None else [(true, TRUE), (found, FOUND)]
    overlay(views, cameras, curves).save(path)
