"""Master curves drawn densely, between the places where a protocol measures and a little beyond them.

Where the master curve has a formula or a quick solver, the dense curve is that. Where one point of it takes seconds, it
is the monotone cubic [Fritsch, Carlson 1980] through the exact values at the measured places: a picture, and never what
anything is compared with.
"""

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator

from stickslip_sim_core.protocols.result import Curve
from stickslip_sim_core.reference import master_curves

POINTS = 200

Floats = npt.NDArray[np.float64]

_EXACT: Mapping[str, Callable[[Floats], Floats]] = {
    "cantilever": master_curves.cantilever,
    "rod-cantilever": master_curves.cantilever,
    "inclined-plane": lambda mu: mu,
    "stacked-incline": lambda mu: mu,
    "stick-slip": lambda mu: mu,
    "rod-lateral-buckling": lambda poisson: np.full_like(poisson, master_curves.lateral_buckling_rod()),
}


def dense_master(protocol: str, curve: Curve) -> tuple[Floats, Floats]:
    """Return 200 abscissae and the master curve there; what is measured once has no curve unless there is a formula."""
    x, y = np.array(curve.x), np.array(curve.master)
    known = np.isfinite(x) & np.isfinite(y)
    x, order = np.unique(x[known], return_index=True)
    y = y[known][order]
    if len(x) == 0:
        return x, y
    dense = _spread(x)
    if protocol in _EXACT:
        return dense, np.asarray(_EXACT[protocol](dense), dtype=np.float64)
    if len(x) < 2:
        return x, y
    is_log = bool(x[0] > 0.0 and np.all(y > 0.0))
    dense = np.geomspace(x[0], x[-1], POINTS) if is_log else np.linspace(x[0], x[-1], POINTS)
    if is_log:
        return dense, np.exp(PchipInterpolator(np.log(x), np.log(y))(np.log(dense)))
    return dense, np.asarray(PchipInterpolator(x, y)(dense))


def _spread(x: Floats) -> Floats:
    """Return abscissae from the first to the last measured one, or around a single one."""
    first, last = (x[0], x[-1]) if len(x) > 1 else (x[0] / 1.5, x[0] * 1.5)
    return np.geomspace(first, last, POINTS) if first > 0.0 else np.linspace(first, last, POINTS)
