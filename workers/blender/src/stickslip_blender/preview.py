"""Small pictures for the dashboard."""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt
from PIL import Image


def side_by_side(views: npt.NDArray[np.uint8]) -> bytes:
    """Return a PNG of views (n, height, width, 3) in a row."""
    file = io.BytesIO()
    Image.fromarray(np.concatenate(list(views), axis=1)).save(file, format="PNG", compress_level=6)
    return file.getvalue()
