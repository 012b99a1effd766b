"""The albedo of many textures at once, where a camera sees them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stickslip_blender.raster import _raster
from stickslip_blender.raster.visibility import Seen

_LANES = 8  # channels are filled up to a multiple


class Textures:
    """Pictures of one size, packed so that one lookup serves all of them."""

    def __init__(self, pictures: Sequence[npt.NDArray[np.uint8]]) -> None:
        """Pack pictures (size, size, 3), 8-bit sRGB, row 0 at v = 0."""
        shapes = {picture.shape for picture in pictures}
        if len(shapes) != 1 or (shape := shapes.pop()) != (shape[0], shape[0], 3):
            raise ValueError(f"textures must be pictures of one shape (size, size, 3); got {sorted(shapes)}")
        self.count = len(pictures)
        channels = -(-3 * self.count // _LANES) * _LANES
        self.texels = np.zeros((shape[0], shape[0], channels), dtype=np.float32)
        for number, picture in enumerate(pictures):
            self.texels[..., 3 * number : 3 * number + 3] = picture / np.float32(255)


@dataclass(frozen=True)
class Albedo:
    """What the pixels of a window see of a cloth."""

    coverage: npt.NDArray[np.float32]
    """Share of each pixel, shape (height, width)."""
    mean: npt.NDArray[np.float32]
    """Linear albedo of what is seen of the cloth, 0 where nothing is; shape (height, width, textures, 3)."""
    hits: npt.NDArray[np.int32]
    """Samples that see each of the cloth's triangles."""
    overall: npt.NDArray[np.float32]
    """Mean albedo of all that is seen of the cloth, shape (textures, 3)."""
    area: float
    """Of the cloth's triangles, each seen alone [pixels]."""


def see_albedo(seen: Seen, uv: npt.NDArray[np.float64], textures: Textures, cloth: int) -> Albedo:
    """Mean textures over what is seen of the first `cloth` triangles; uv: texture coordinates (V, 2) in [0, 1]."""
    return Albedo(
        *_raster.albedo(
            seen.triangle,
            seen.points,
            seen.triangles,
            uv,
            cloth,
            textures.texels,
            textures.count,
            seen.window.place,
            seen.grid,
        )
    )
