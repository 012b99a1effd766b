"""The array types of the package's signatures, and checks of numbers."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise ValueError unless a number is in [low, high]."""
    if not low <= value <= high:
        raise ValueError(f"{name}: must be in [{low:g}, {high:g}], got {value}")


def check_positive(**numbers: float) -> None:
    """Raise ValueError unless numbers are finite and positive."""
    for name, value in numbers.items():
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"{name}: must be finite and > 0, got {value}")
