"""Rods and cloths to look at, without a solver."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from stickslip_schemas.spec.cameras import Camera, load_rig


@pytest.fixture
def curl() -> npt.NDArray[np.float64]:
    """A hanging curl of length 1 that opens downwards, clamp at the origin, shape (150, 3)."""
    s = np.linspace(0.0, 1.0, 150)
    tilt, turn = 1.1 * np.sqrt(s), 6.0 * np.pi * s**1.3
    tangent = np.stack(
        [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)], axis=1
    )
    steps = 0.5 * (tangent[1:] + tangent[:-1]) / 149
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


@dataclass(frozen=True)
class Sheet:
    """A square of cloth and where it goes."""

    triangles: npt.NDArray[np.int32]
    rest: npt.NDArray[np.float32]
    track: npt.NDArray[np.float32]


def _sheet(side: int = 9, *, reach: float = 0.3) -> Sheet:
    """Drag a wrinkled sheet of side x side vertices from x = 0 to a reach [m] in four instants."""
    line = np.linspace(-0.1, 0.1, side)
    rest = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    number = np.arange(side**2).reshape(side, side)
    a, b, c, d = (
        number[i : side - 1 + i, j : side - 1 + j].ravel() for i in (0, 1) for j in (0, 1)
    )
    triangles = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    below = 0.1 - rest[:, 1]  # from the held edge, along the sheet
    hanging = np.minimum(below, 0.16)
    wrinkle = 0.008 * below / 0.2 * np.sin(60.0 * rest[:, 0])
    x = -0.05 * hanging / 0.16 - (below - hanging) + wrinkle
    z = 0.15 * (1.0 - hanging / 0.16)
    track = np.stack(
        [np.stack([x + shift, rest[:, 0], z], axis=1) for shift in np.linspace(0.0, reach, 4)]
    )
    return Sheet(triangles.astype(np.int32), rest.astype(np.float32), track.astype(np.float32))


@pytest.fixture(scope="session")
def make_sheet() -> Callable[..., Sheet]:
    return _sheet


@pytest.fixture
def sheet() -> Sheet:
    return _sheet()


@pytest.fixture
def rig() -> tuple[Camera, ...]:
    return load_rig("rod-4")
