"""Rods to look at, without a solver."""

import numpy as np
import numpy.typing as npt
import pytest
from stickslip_schemas.cameras import Camera, load_rig


@pytest.fixture
def curl() -> npt.NDArray[np.float64]:
    """A hanging curl of length 1 that opens downwards, clamp at the origin, shape (150, 3)."""
    s = np.linspace(0.0, 1.0, 150)
    tilt, turn = 1.1 * np.sqrt(s), 6.0 * np.pi * s**1.3
    tangent = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)], axis=1)
    steps = 0.5 * (tangent[1:] + tangent[:-1]) / 149
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


@pytest.fixture
def rig() -> tuple[Camera, ...]:
    return load_rig("rod-4")
