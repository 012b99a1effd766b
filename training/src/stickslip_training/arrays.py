"""The types of NumPy arrays, named once."""

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
"""Of any type of number."""

Floats = npt.NDArray[np.float64]
"""Results in double precision."""

SingleFloats = npt.NDArray[np.float32]
"""Input of networks, and content of datasets."""

AnyFloats = npt.NDArray[np.floating[Any]]
"""Of either precision."""

Integers = npt.NDArray[np.int64]
