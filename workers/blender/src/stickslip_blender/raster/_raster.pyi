"""The compiled rasteriser."""

import numpy as np
from numpy.typing import NDArray

_Part = tuple[int, int, int, int]

BUILD_HASH: str

def visible(
    points: NDArray[np.float64], triangles: NDArray[np.int32], window: _Part, grid: int
) -> NDArray[np.int32]: ...
def albedo(
    seen: NDArray[np.int32],
    points: NDArray[np.float64],
    triangles: NDArray[np.int32],
    coordinates: NDArray[np.float64],
    end: int,
    texels: NDArray[np.float32],
    count: int,
    window: _Part,
    grid: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]: ...
def decoded(srgb: float) -> float: ...
