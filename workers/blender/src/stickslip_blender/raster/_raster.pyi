"""The compiled rasteriser."""

import numpy as np
from numpy.typing import NDArray

_Part = tuple[int, int, int, int]

BUILD_HASH: str
TOLERANCE: int

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
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32], NDArray[np.float32], float]: ...
def compose(
    trace: NDArray[np.uint16],
    albedos: tuple[float, float, float],
    overall: NDArray[np.float32],
    coverage: NDArray[np.float32],
    mean: NDArray[np.float32],
    window: _Part,
    reflected: NDArray[np.float32],
    reflected_window: _Part,
    floor: NDArray[np.float32],
    pictures: NDArray[np.uint8],
) -> None: ...
def blurred(
    values: NDArray[np.float32], down: NDArray[np.float32], across: NDArray[np.float32]
) -> NDArray[np.float32]: ...
def normals(points: NDArray[np.float64], triangles: NDArray[np.int32]) -> NDArray[np.float64]: ...
def decoded(srgb: float) -> float: ...
