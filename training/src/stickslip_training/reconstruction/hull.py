"""The visual hull as a cloud of points, and the thesis's way from it to a centreline [thesis, 5.3.1].

A cloud has no order, and where turns of a curl come close in several views it has bridges and phantoms. So this is a
start for the refinement beside those of `tracking`, and what the refined curve is compared with.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from stickslip_training.arrays import Floats
from stickslip_training.reconstruction.view import View

ROOM = 1.05  # [L]: the rod cannot reach farther from its clamp
CELL = 0.0025  # [L]: the cloud's spacing, about half a pixel of the views that the project renders
MOST_CELLS = 400_000  # a hull this large is no rod's


class HullTooLargeError(ValueError):
    """The silhouettes leave room for far more than a slender rod."""


def visual_hull(views: Sequence[View], cell: float = CELL) -> Floats:
    """Return the points, at most `cell` [L] apart, whose images lie in every silhouette, (n, 3) [L].

    Cubes are halved again and again; those are kept whose surrounding ball touches every silhouette.
    """
    outside = [ndimage.distance_transform_edt(view.coverage < 0.5) for view in views]
    halvings = int(np.ceil(np.log2(2.0 * ROOM / cell)))
    centers, side = np.zeros((1, 3)), 2.0 * ROOM
    corners = np.array([[x, y, z] for x in (-0.25, 0.25) for y in (-0.25, 0.25) for z in (-0.25, 0.25)])
    for level in range(halvings + 1):
        if level > 0:
            centers, side = (centers[:, None] + side * corners).reshape(-1, 3), side / 2.0
        reach = 0.5 * np.sqrt(3.0) * side if level < halvings else 0.0
        for view, distance in zip(views, outside, strict=True):
            centers = centers[_touches(view, distance, centers, reach)]
        if len(centers) > MOST_CELLS:
            raise HullTooLargeError(
                f"views: the silhouettes leave room for more than {MOST_CELLS} cells of {side:.3g} L; "
                "they must be those of one slender rod"
            )
    return centers


def _touches(view: View, distance: Floats, points: Floats, reach: float) -> npt.NDArray[np.bool_]:
    pixels, depth = view.project(points)
    height, width = distance.shape
    nearest = np.rint(pixels)
    inside = np.clip(nearest, 0, [width - 1, height - 1])
    out_of_frame = np.linalg.norm(nearest - inside, axis=1)
    u, v = inside.astype(np.int64).T
    away = np.maximum(distance[v, u], out_of_frame)
    allowed = float(view.f.max()) * reach / np.maximum(depth - reach, 1e-3) + 0.71  # half a pixel's diagonal
    if reach == 0.0:
        allowed = np.zeros(len(points))
    touches: npt.NDArray[np.bool_] = away <= allowed
    return touches


def moving_cylinder(cloud: Floats, radius: float, direction: Floats, step: float = 0.01) -> Floats:
    """Return a polyline (n, 3) [L] through a cloud: centroids of what a cylinder holds that moves along the rod.

    The cylinder begins at the clamp, reaches two steps ahead and is three radii wide; it turns towards each centroid,
    and the polyline ends where it is empty, or after twice the rod's length.
    """
    points, heading = [np.zeros(3)], direction / np.linalg.norm(direction)
    for _ in range(int(2.0 / step)):
        offset = cloud - points[-1]
        ahead = offset @ heading
        aside = np.linalg.norm(offset - ahead[:, None] * heading, axis=1)
        held = (ahead > 0.0) & (ahead < 2.0 * step) & (aside < 3.0 * radius)
        if not held.any():
            break
        toward = offset[held].mean(axis=0)
        toward /= np.linalg.norm(toward)
        heading = heading + toward
        heading /= np.linalg.norm(heading)
        points.append(points[-1] + step * toward)
    return np.array(points)
