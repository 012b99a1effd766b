"""Labels of the shape of a hanging rod: its distance from itself, and its sideways reach."""

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.rods.solve import finite_array


def reach(centerline: ArrayLike) -> Floats:
    """Return the largest distance of each rod from the vertical through its clamp, z being up: (n,) [L].

    `centerline` has positions (n, points, 3) [L] from the clamp on; where it is NaN, so is the distance.
    """
    r = _centerlines(centerline)
    return np.asarray(np.linalg.norm(r[..., :2] - r[:, :1, :2], axis=2).max(axis=1))


def self_contact_distance(centerline: ArrayLike) -> Floats:
    """Return the least distance of each centreline from another part of itself.

    Neighbouring parts are always close; what counts is a local minimum of the distance between two points of the
    centreline, each free to slide along it: the doubly critical distance of the theory of ideal knots [Gonzalez and
    Maddocks 1999], ends included. A rod of radius r touches itself where it is below 2 r.

    `centerline` has positions (n, points, 3) [L], joined by straight segments. The distance (n,) [L] is infinite where
    it has no such minimum, as on a straight rod, and NaN where the centreline is.
    """
    r = _centerlines(centerline)
    return np.array([_self_contact_distance(rod) for rod in r]).reshape(len(r))


def _centerlines(centerline: ArrayLike) -> Floats:
    r = np.asarray(centerline)
    finite_array("centerline", np.nan_to_num(r) if r.dtype.kind == "f" else r, (None, None, 3))
    if r.shape[1] < 2:
        raise ValueError(f"centerline: must have at least 2 points, got {r.shape[1]}")
    return np.asarray(r, dtype=np.float64)


def _self_contact_distance(r: Floats) -> float:
    """Of one rod, shape (points, 3)."""
    if np.isnan(r).any():
        return np.nan
    p = len(r)
    squared = (r**2).sum(axis=1)
    distance2 = squared[:, None] + squared - 2.0 * (r @ r.T)
    # No point is farther from another than from those around it: local minima over the eight neighbours.
    padded = np.full((p + 2, p + 2), np.inf)
    padded[1:-1, 1:-1] = distance2
    around = [padded[1 + i : p + 1 + i, 1 + j : p + 1 + j] for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    minimal = distance2 <= np.minimum.reduce(around)
    first, second = np.nonzero(np.triu(minimal, k=2))
    if first.size == 0:
        return np.inf
    # The minimum lies on one of the segments that meet at the two points.
    a, b = (np.stack([np.clip(x - 1, 0, p - 2), np.clip(x, 0, p - 2)]) for x in (first, second))
    i, j = (x.ravel() for x in np.broadcast_arrays(a[:, None], b[None, :]))
    apart = j - i >= 2
    return float(_segment_distance(r[i[apart]], r[i[apart] + 1], r[j[apart]], r[j[apart] + 1]).min(initial=np.inf))


def _segment_distance(a0: Floats, a1: Floats, b0: Floats, b1: Floats) -> Floats:
    """Distances between segments a0-a1 and b0-b1, each shape (k, 3) [Ericson 2004, Sec. 5.1.9]."""
    u, v, w = a1 - a0, b1 - b0, a0 - b0
    uu, uv, vv, uw, vw = ((x * y).sum(axis=1) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    tiny = np.finfo(float).tiny
    determinant = uu * vv - uv**2
    s = np.where(determinant > 1e-14 * uu * vv, np.clip((uv * vw - vv * uw) / np.maximum(determinant, tiny), 0, 1), 0.0)
    t = np.clip((uv * s + vw) / np.maximum(vv, tiny), 0.0, 1.0)
    s = np.clip((uv * t - uw) / np.maximum(uu, tiny), 0.0, 1.0)
    return np.asarray(np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1))
