"""Follow the rod from the clamp through all views at once.

Steps of one length go from the clamp to the free end. Of all ways that can be gone so, those are kept (a beam) whose
points lie in the middle of every silhouette and that bend evenly: at a crossing in one view the other views and the
even bend say where to go on, and a way that takes a short cut has length left over that no silhouette has room for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from stickslip_training.arrays import Floats
from stickslip_training.reconstruction.view import View

STEPS = 100
BEAM = 200  # ways that are kept
RINGS = ((0.07, 6), (0.16, 8), (0.30, 12), (0.5, 12))  # angles to the even bend [rad], directions on each
UNEVEN = 1.0  # cost of a change of direction against the even bend [1/rad^2]
BENT = 0.05  # cost of any change of direction [1/rad^2]
CELL = 0.006  # [L]: of two ways at one place, in one direction, the better is kept
TURN = 0.35  # the side of a cell of directions


@dataclass(frozen=True, slots=True)
class Track:
    """One way: points (STEPS + 1, 3) one step apart, and what it cost."""

    points: Floats
    cost: float


def follow(views: Sequence[View], radius: float, direction: Floats, ways: int = 5) -> list[Track]:
    """Return the best ways from the clamp, cheapest first, each unlike the ones before it; radius [L]."""
    fields = [_middle(view, radius) for view in views]
    step = 1.0 / STEPS
    position = np.zeros((1, 3))
    heading = direction[None] / np.linalg.norm(direction)
    turn = np.zeros((1, 3))  # rotation vector of the last step
    cost = np.zeros(1)
    parents: list[npt.NDArray[np.int64]] = []
    trail = [position]
    for _ in range(STEPS):
        ahead = _rotate(heading, turn)
        candidates = _cone(ahead)  # (n, m, 3)
        n, m = candidates.shape[:2]
        middle = heading[:, None] + candidates
        places = position[:, None] + step * middle / np.linalg.norm(middle, axis=-1, keepdims=True)
        flat = candidates.reshape(-1, 3)
        parent = np.repeat(np.arange(n), m)
        total = (
            cost[parent]
            + sum(_outside(view, field, places.reshape(-1, 3)) for view, field in zip(views, fields, strict=True))
            + UNEVEN * _squared(flat - ahead[parent])
            + BENT * _squared(flat - heading[parent])
        )
        kept = _best_of_cells(places.reshape(-1, 3), flat, total)
        parents.append(parent[kept])
        turn = _rotation(heading[parent[kept]], flat[kept])
        position, heading, cost = places.reshape(-1, 3)[kept], flat[kept], total[kept]
        trail.append(position)
    return _unlike(trail, parents, cost, ways)


def _middle(view: View, radius: float) -> Floats:
    """Return how much of the rod's disc about each pixel lies in the silhouette: 1 in its middle."""
    size = radius * view.focal / float(np.linalg.norm(view.t))
    solid = np.minimum(view.coverage, 1.0)
    return np.asarray(ndimage.gaussian_filter(solid, 0.6 * size)) / _peak(0.6 * size, size)


def _peak(sigma: float, radius: float) -> float:
    """What the Gaussian filter leaves in the middle of a straight strip of coverage 1."""
    from scipy.special import erf

    return float(erf(radius / sigma / np.sqrt(2.0)))


def _outside(view: View, field: Floats, points: Floats) -> Floats:
    pixels, _ = view.project(points)
    value = ndimage.map_coordinates(field, pixels[:, ::-1].T, order=1, mode="constant", cval=0.0)
    miss: Floats = np.maximum(1.0 - value, 0.0) ** 2
    return miss


def _cone(ahead: Floats) -> Floats:
    """Return directions around each of (n, 3), itself first, (n, m, 3)."""
    axis = np.eye(3)[np.argmin(np.abs(ahead), axis=1)]
    right = np.cross(ahead, axis)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(ahead, right)
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
    rotation: Floats = axis * (angle / np.maximum(sine, 1e-12))
    return rotation


def _rotate(vectors: Floats, rotation: Floats) -> Floats:
    """Rotate vectors that are at right angles to the axes of their rotations."""
    angle = np.linalg.norm(rotation, axis=1, keepdims=True)
    axis = rotation / np.maximum(angle, 1e-12)
    rotated: Floats = np.cos(angle) * vectors + np.sin(angle) * np.cross(axis, vectors)
    rotated /= np.linalg.norm(rotated, axis=1, keepdims=True)
    return rotated


def _squared(vectors: Floats) -> Floats:
    squared: Floats = np.einsum("ij,ij->i", vectors, vectors)
    return squared


def _best_of_cells(places: Floats, directions: Floats, cost: Floats) -> npt.NDArray[np.int64]:
    """Return the cheapest ways, at most BEAM of them and one of each cell of places and directions."""
    few = np.argpartition(cost, 8 * BEAM)[: 8 * BEAM] if len(cost) > 8 * BEAM else np.arange(len(cost))
    order = few[np.argsort(cost[few], kind="stable")]
    sides = np.concatenate([np.rint(places[order] / CELL), np.rint(directions[order] / TURN)], axis=1).astype(np.int64)
    cell = np.zeros(len(order), dtype=np.int64)
    for side in sides.T:
        cell = cell * 1024 + side + 512  # a side is a few hundred cells long at most; six of them fit in 60 bits
    _, first = np.unique(cell, return_index=True)
    return order[np.sort(first)[:BEAM]]


def _unlike(
    trail: list[Floats], parents: list[npt.NDArray[np.int64]], cost: Floats, ways: int, apart: float = 0.02
) -> list[Track]:
    tracks: list[Track] = []
    for end in np.argsort(cost, kind="stable"):
        index, points = int(end), []
        for positions, parent in zip(reversed(trail[1:]), reversed(parents), strict=True):
            points.append(positions[index])
            index = int(parent[index])
        points.append(trail[0][0])
        way = np.array(points[::-1])
        if all(np.linalg.norm(way - other.points, axis=1).max() > apart for other in tracks):
            tracks.append(Track(way, float(cost[end])))
            if len(tracks) == ways:
                break
    return tracks
