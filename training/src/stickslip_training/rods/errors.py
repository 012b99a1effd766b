"""How wrong a curvature is.

kappa = (twist, bend1, bend2) L are the strains of a rod. Its centreline has the curvature |kappa| = sqrt(bend1^2 +
bend2^2) L: the twist is that of the material about the centreline, which an estimate from the centreline alone cannot
see. So errors that compare methods are errors of |kappa|.
"""

import numpy as np

from stickslip_training.arrays import AnyFloats, Floats


def bending(strains: AnyFloats) -> Floats:
    """Return |kappa| L, (..., points), of strains (..., points, 3)."""
    return np.asarray(np.hypot(strains[..., 1], strains[..., 2]), dtype=np.float64)


def rms(difference: AnyFloats) -> float:
    """Return the root mean square of all entries."""
    return float(np.sqrt(np.mean(np.square(difference, dtype=np.float64))))


def relative_rms_error(estimate: AnyFloats, truth: AnyFloats) -> Floats:
    """Return the RMS relative error of each rod, (rods,), of |kappa| L, (rods, points):

    sqrt(mean_s (estimate - truth)^2) / sqrt(mean_s truth^2), over all points, the ends included.
    """
    error = np.sqrt(np.mean(np.square(estimate - truth, dtype=np.float64), axis=-1))
    return np.asarray(error / np.sqrt(np.mean(np.square(truth, dtype=np.float64), axis=-1)))
