"""The array types of the package's signatures."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
