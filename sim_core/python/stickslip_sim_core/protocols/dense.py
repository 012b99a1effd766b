"""Dense master curves, for pictures of protocol results."""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.interpolate import PchipInterpolator

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.protocols.result import Curve
from stickslip_sim_core.reference import master_curves

POINTS = 200  # of a master curve

_EXACT: Mapping[str, Callable[[Floats], Floats]] = {
    "cantilever": master_curves.cantilever,
    "rod-cantilever": master_curves.cantilever,
    "inclined-plane": lambda mu: mu,
    "stacked-incline": lambda mu: mu,
    "stick-slip": lambda mu: mu,
    "rod-lateral-buckling": lambda poisson: np.full_like(poisson, master_curves.lateral_buckling_rod()),
}


def dense_master(protocol: str, curve: Curve) -> tuple[Floats, Floats]:
    """Return 200 abscissae between the measured ones, and the master curve there.

    It is exact where the master curve has a formula or a quick solver. Elsewhere it is the monotone cubic [Fritsch,
    Carlson 1980] through the exact values: for pictures only. A single point without a formula has no curve.
    """
    x, y = np.array(curve.x), np.array(curve.master)
    known = np.isfinite(x) & np.isfinite(y)
    x, order = np.unique(x[known], return_index=True)
    y = y[known][order]
    if len(x) == 0 or (len(x) == 1 and protocol not in _EXACT):
        return x, y
    first, last = (x[0], x[-1]) if len(x) > 1 else (x[0] / 1.5, x[0] * 1.5)
    if protocol in _EXACT:
        dense = np.geomspace(first, last, POINTS) if first > 0.0 else np.linspace(first, last, POINTS)
        return dense, np.asarray(_EXACT[protocol](dense), dtype=np.float64)
    if first > 0.0 and np.all(y > 0.0):
        dense = np.geomspace(first, last, POINTS)
        return dense, np.exp(PchipInterpolator(np.log(x), np.log(y))(np.log(dense)))
    dense = np.linspace(first, last, POINTS)
    return dense, np.asarray(PchipInterpolator(x, y)(dense))
