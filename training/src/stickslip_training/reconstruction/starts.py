"""Starts for the refinement: curves from the clamp to the free end.

`follow` goes through all views at once, in steps of one length. A beam search keeps the ways whose
points lie in the middle of every silhouette and that bend evenly. At a crossing in one view, the
other views and the even bend decide. A way that takes a short cut has length left over for which no
silhouette has room.

`visual_hull` is a cloud of points, and `moving_cylinder` the thesis's way from it to a centreline
[thesis, 5.3.1]. A cloud has no order, and where turns of a curl come close in several views it has
bridges and phantoms.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial.transform import Rotation
from scipy.special import erf

from stickslip_training.arrays import Floats
from stickslip_training.reconstruction.views import View

STEPS = 100
BEAM = 200  # ways that are kept
RINGS = (
    (0.07, 6),
    (0.16, 8),
    (0.30, 12),
    (0.5, 12),
)  # angles to the even bend [rad], directions on each
UNEVEN = 1.0  # cost of a change of direction against the even bend [1/rad^2]
BENT = 0.05  # cost of any change of direction [1/rad^2]
CELL = 0.006  # [L]: of two ways at one place, in one direction, the better is kept
TURN = 0.35  # the side of a cell of directions
APART = 0.02  # [L]: curves that are farther apart anywhere are different curves
BLUR = 0.6  # deviation of the filter of `_middle`, over the rod's radius
PEAK = float(erf(1.0 / BLUR / np.sqrt(2.0)))
"""Value that the filter leaves in the middle of a straight strip of coverage 1."""


def follow(views: Sequence[View], radius: float, direction: Floats, count: int = 5) -> list[Floats]:
    """Return the best paths from the clamp, (STEPS + 1, 3) each, one step apart; radius [L].

    The cheapest comes first, and each is unlike all before it.
    """
    fields = [_middle(view, radius) for view in views]
    step = 1.0 / STEPS
    trail = np.zeros((1, 1, 3))  # (ways, places, 3)
    heading = direction[None] / np.linalg.norm(direction)
    turn = np.zeros((1, 3))  # rotation vector of the last step
    cost = np.zeros(1)
    for _ in range(STEPS):
        # A rod bends evenly: the likeliest turn is that of the last step.
        ahead = Rotation.from_rotvec(turn).apply(heading)
        candidates = _cone(ahead)  # (n, m, 3)
        n, m = candidates.shape[:2]
        # A step goes along the chord of the arc from the old direction to the new one.
        middle = heading[:, None] + candidates
        places = (
            trail[:, -1:] + step * middle / np.linalg.norm(middle, axis=-1, keepdims=True)
        ).reshape(-1, 3)
        flat = candidates.reshape(-1, 3)
        parent = np.repeat(np.arange(n), m)
        # The cost of a path: points outside of silhouettes, uneven bends, and any bend at all.
        total = (
            cost[parent]
            + sum(_outside(view, field, places) for view, field in zip(views, fields, strict=True))
            + UNEVEN * _squared(flat - ahead[parent])
            + BENT * _squared(flat - heading[parent])
        )
        beam = _best_of_cells(places, flat, total)
        turn = _rotation(heading[parent[beam]], flat[beam])
        trail = np.concatenate([trail[parent[beam]], places[beam, None]], axis=1)
        heading = flat[beam]
        cost = total[beam]
    # The beam holds many paths that differ in nothing but their last steps.
    paths: list[Floats] = []
    for path in trail[np.argsort(cost, kind="stable")]:
        if all(np.linalg.norm(path - other, axis=1).max() > APART for other in paths):
            paths.append(path)
    return paths[:count]


def _middle(view: View, radius: float) -> Floats:
    """Return the fraction of the rod's disc about each pixel that is in the silhouette."""
    # The rod's size in this view, at the distance of its clamp.
    size = radius * view.focal / float(np.linalg.norm(view.t))
    solid = np.minimum(view.coverage, 1.0)
    return np.asarray(ndimage.gaussian_filter(solid, BLUR * size)) / PEAK


def _outside(view: View, field: Floats, points: Floats) -> Floats:
    pixels, _ = view.project(points)
    value = ndimage.map_coordinates(field, pixels[:, ::-1].T, order=1, mode="constant", cval=0.0)
    return np.asarray(np.maximum(1.0 - value, 0.0) ** 2)


def _cone(ahead: Floats) -> Floats:
    """Return directions around each of (n, 3), itself first, (n, m, 3)."""
    # Any axis across will do: the one that is least along the direction.
    axis = np.eye(3)[np.argmin(np.abs(ahead), axis=1)]
    right = np.cross(ahead, axis)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(ahead, right)
    # Rings about the direction; the rays of one ring lie between those of the next.
    rays = [ahead]
    for angle, count in RINGS:
        for azimuth in 2.0 * np.pi / count * (np.arange(count) + 0.5 * angle):
            sideways = np.cos(azimuth) * right + np.sin(azimuth) * up
            rays.append(np.cos(angle) * ahead + np.sin(angle) * sideways)
    return np.stack(rays, axis=1)


def _rotation(before: Floats, after: Floats) -> Floats:
    """Return the least rotation that takes unit vectors to others, as rotation vectors (n, 3)."""
    axis = np.cross(before, after)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, np.sum(before * after, axis=1, keepdims=True))
    return np.asarray(axis * (angle / np.maximum(sine, 1e-12)))


def _squared(vectors: Floats) -> Floats:
    return np.asarray(np.einsum("ij,ij->i", vectors, vectors))


def _best_of_cells(places: Floats, directions: Floats, cost: Floats) -> npt.NDArray[np.int64]:
    """Return the cheapest paths, at most BEAM, and one of each cell of positions and directions."""
    # Sorting all candidates would cost more than all the rest of a step.
    cheap = np.arange(len(cost))
    if len(cost) > 8 * BEAM:
        cheap = np.argpartition(cost, 8 * BEAM)[: 8 * BEAM]
    order = cheap[np.argsort(cost[cheap], kind="stable")]
    sides = np.concatenate(
        [np.rint(places[order] / CELL), np.rint(directions[order] / TURN)], axis=1
    ).astype(np.int64)
    cell = np.zeros(len(order), dtype=np.int64)
    for side in sides.T:
        # A side is a few hundred cells long at most, so six of them fit in 60 bits.
        cell = cell * 1024 + side + 512
    _, first = np.unique(cell, return_index=True)
    return order[np.sort(first)[:BEAM]]


ROOM = 1.05  # [L]: the rod cannot reach farther from its clamp
HULL_CELL = 0.0025
"""Spacing of the cloud [L]: about half a pixel of the views that the project renders."""
MOST_CELLS = 400_000  # a hull this large is no rod's


def visual_hull(views: Sequence[View], cell: float = HULL_CELL) -> Floats:
    """Return points whose images lie in every silhouette, (n, 3) [L].

    Points are at most `cell` [L] apart.

    There are none if the silhouettes leave room for far more than a slender rod. Cubes are
    halved again and again; a cube is kept if its surrounding ball touches every silhouette.
    """
    outside = [ndimage.distance_transform_edt(view.coverage < 0.5) for view in views]
    halvings = int(np.ceil(np.log2(2.0 * ROOM / cell)))
    centers = np.zeros((1, 3))
    side = 2.0 * ROOM
    # Centres of the eight halves of a cube, over its side.
    corners = np.stack(np.meshgrid(*[(-0.25, 0.25)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for level in range(halvings + 1):
        if level > 0:
            centers = (centers[:, None] + side * corners).reshape(-1, 3)
            side = side / 2.0
        # At the last level the centre itself must be in every silhouette.
        reach = 0.5 * np.sqrt(3.0) * side if level < halvings else 0.0
        for view, distance in zip(views, outside, strict=True):
            centers = centers[_touches(view, distance, centers, reach)]
        # A hull this large means that the silhouettes do not bound a rod.
        if len(centers) > MOST_CELLS:
            return np.zeros((0, 3))
    return centers


def _touches(view: View, distance: Floats, points: Floats, reach: float) -> npt.NDArray[np.bool_]:
    pixels, depth = view.project(points)
    height, width = distance.shape
    nearest = np.rint(pixels)
    inside = np.clip(nearest, 0, [width - 1, height - 1])
    out_of_frame = np.linalg.norm(nearest - inside, axis=1)
    u, v = inside.astype(np.int64).T
    # A point out of the picture is as far away as its nearest pixel.
    away = np.maximum(distance[v, u], out_of_frame)
    # The ball about a cube may touch a silhouette half a pixel's diagonal away.
    allowed = float(view.f.max()) * reach / np.maximum(depth - reach, 1e-3) + 0.71
    if reach == 0.0:
        allowed = np.zeros(len(points))
    return np.asarray(away <= allowed)


def moving_cylinder(cloud: Floats, radius: float, direction: Floats, step: float = 0.01) -> Floats:
    """Return a polyline (n, 3) [L] through a cloud.

    Its points are centroids of the part of the cloud in a cylinder that moves along the rod.

    The cylinder begins at the clamp, reaches two steps ahead and is three radii wide; it turns
    towards each centroid, and the polyline ends when it is empty, or after twice the rod's length.
    """
    points = [np.zeros(3)]
    heading = direction / np.linalg.norm(direction)
    for _ in range(int(2.0 / step)):
        offset = cloud - points[-1]
        ahead = offset @ heading
        aside = np.linalg.norm(offset - ahead[:, None] * heading, axis=1)
        is_inside = (ahead > 0.0) & (ahead < 2.0 * step) & (aside < 3.0 * radius)
        if not is_inside.any():
            break
        toward = offset[is_inside].mean(axis=0)
        toward /= np.linalg.norm(toward)
        # Half a turn towards the centroid, so that single points do not throw it off.
        heading = heading + toward
        heading /= np.linalg.norm(heading)
        points.append(points[-1] + step * toward)
    return np.array(points)
