"""The array types of the package's signatures, and checks of numbers."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Check that a number is in [low, high].

    Raises:
        ValueError: It is outside.
    """
    if not low <= value <= high:
        raise ValueError(f"{name}: must be in [{low:g}, {high:g}], got {value}")


def check_positive(**numbers: float) -> None:
    """Check that numbers are finite and positive.

    Raises:
        ValueError: One is not.
    """
    for name, value in numbers.items():
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"{name}: must be finite and > 0, got {value}")
