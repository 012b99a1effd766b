"""A figure from the hips up, whose skin follows its bones, and the motion of the scene `shawl`.

World axes: x is where it looks, y its left, z up; its hips rise from the floor z = 0. Its skin at rest is the zero of a
smooth union of ellipsoids and tapered limbs [Quilez 2013], as even triangles. Bones move it by linear blend skinning: a
vertex goes where the mean of the bones takes it, each by its weight.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core.arrays import Floats

SPACING = 0.03
"""Of the cells that the skin is found in, about the length of its edges [m]."""

BLEND = 0.08
"""How far from where two parts meet the skin is rounded [m]."""

WEIGHT_LENGTH = 0.015
"""Distance over which weights of bones fall by e [m]."""

WAIST, NECK, SHOULDER = (0.0, 0.0, 0.16), (0.0, 0.0, 0.62), (0.0, 0.185, 0.525)
"""Joints of chest, head and left arm [m]."""

STILL = 3.0
"""Time before the figure moves [s]."""

EASE = 2.0
"""Time in which its motion grows to its size [s]."""

BONES = ("hips", "chest", "head", "left arm", "right arm")

Field = Callable[[Floats], Floats]


def _ellipsoid(center: tuple[float, float, float], radii: tuple[float, float, float]) -> Field:
    """Return the approximate distance from an ellipsoid [Quilez 2008]: |q| (|q| - 1) / |q / r|, q = (p - c) / r."""
    c, r = np.array(center), np.array(radii)

    def distance(p: Floats) -> Floats:
        q = (p - c) / r
        size = np.sqrt((q * q).sum(axis=-1))
        found: Floats = size * (size - 1.0) / np.maximum(np.sqrt(((q / r) ** 2).sum(axis=-1)), 1e-9)
        return found

    return distance


def _limb(*joints: tuple[float, float, float, float]) -> Field:
    """Return the approximate distance from a limb along joints (x, y, z, radius); radii change evenly between."""
    knots = np.array(joints)

    def distance(p: Floats) -> Floats:
        found = np.full(p.shape[:-1], np.inf)
        for first, last in itertools.pairwise(knots):
            along = last[:3] - first[:3]
            share = np.clip(((p - first[:3]) * along).sum(axis=-1) / (along * along).sum(), 0.0, 1.0)
            off = p - first[:3] - share[..., None] * along
            found = np.minimum(found, np.sqrt((off * off).sum(axis=-1)) - first[3] - share * (last[3] - first[3]))
        return found

    return distance


def _mirrored(distance: Field) -> Field:
    return lambda p: distance(p * np.array([1.0, -1.0, 1.0]))


def _union(distances: list[Floats], blend: float = BLEND) -> Floats:
    """Return the smooth union: min(a, b) - h^2 k / 4, h = max(k - |a - b|, 0) / k [Quilez 2013]."""
    found = distances[0]
    for other in distances[1:]:
        h = np.maximum(blend - np.abs(found - other), 0.0) / blend
        found = np.minimum(found, other) - 0.25 * blend * h * h
    return found


_LEFT_ARM = _limb((*SHOULDER, 0.055), (0.0, 0.27, 0.31, 0.045))
_LEFT_SLOPE = _limb((-0.01, 0.03, 0.585, 0.045), (0.0, 0.16, 0.53, 0.05))

_PARTS: tuple[tuple[Field, ...], ...] = (
    (_ellipsoid((0.0, 0.0, 0.0), (0.11, 0.15, 0.17)),),
    (
        _ellipsoid((0.0, 0.0, 0.28), (0.09, 0.125, 0.25)),
        _ellipsoid((0.01, 0.0, 0.42), (0.10, 0.155, 0.13)),
        _LEFT_SLOPE,
        _mirrored(_LEFT_SLOPE),
    ),
    (_limb((-0.01, 0.0, 0.60, 0.042), (0.0, 0.0, 0.70, 0.04)), _ellipsoid((0.015, 0.0, 0.785), (0.095, 0.075, 0.12))),
    (_LEFT_ARM,),
    (_mirrored(_LEFT_ARM),),
)
"""By bone."""

LOW, HIGH = (-0.22, -0.42, -0.24), (0.22, 0.42, 0.98)
"""Corners of a box around the figure at rest [m]."""


def distance(points: Floats) -> Floats:
    """Return the approximate distance of points (..., 3) [m] from the skin at rest, negative inside."""
    return _union([_union([part(points) for part in parts]) for parts in _PARTS])


def _slope(points: Floats) -> Floats:
    """Return the gradient of `distance` (..., 3)."""
    steps = 1e-5 * np.eye(3)
    return np.stack([(distance(points + step) - distance(points - step)) / 2e-5 for step in steps], axis=-1)


@dataclass(frozen=True, eq=False)
class Figure:
    """The skin of the figure at rest."""

    rest: Floats
    """(N, 3) [m]"""

    triangles: NDArray[np.int32]
    """(T, 3), counter-clockwise from outside; the skin is closed."""

    weights: Floats
    """(N, bones): how much each vertex follows each of `BONES`; they add up to 1."""

    def moved(self, bones: Floats) -> Floats:
        """Return the vertices (N, 3) [m] where bones are moved by (bones, 3, 4): x -> A x + b each."""
        found = np.zeros_like(self.rest)
        for weight, bone in zip(self.weights.T, bones, strict=True):
            x, y, z = self.rest.T[..., None]
            found += weight[:, None] * (x * bone[:, 0] + y * bone[:, 1] + z * bone[:, 2] + bone[:, 3])
        return found


@lru_cache
def figure(spacing: float = SPACING) -> Figure:
    """Return the figure with cells of `spacing` [m].

    The skin is found by surface nets [Gibson 1998]: a vertex in each cell that it passes, a square across each edge of
    the grid that it cuts. Vertices are then moved towards their neighbours' mean and back onto the skin, by turns.
    """
    counts = [int(np.ceil((high - low) / spacing)) + 1 for low, high in zip(LOW, HIGH, strict=True)]
    axes = [low + spacing * np.arange(count) for low, count in zip(LOW, counts, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inside = distance(grid) < 0.0
    squares = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        near, far = np.moveaxis(inside, axis, 0)[:-1], np.moveaxis(inside, axis, 0)[1:]
        for cut, order in ((near & ~far, (0, 1, 2, 3)), (~near & far, (3, 2, 1, 0))):
            cell = np.argwhere(np.moveaxis(cut, 0, axis))  # at the near end of the edge
            around = np.tile(cell[:, None], (1, 4, 1))
            around[:, [0, 3], u] -= 1
            around[:, [0, 1], v] -= 1
            squares.append(around[:, order])
    corners = np.concatenate(squares)
    cells, numbers = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    quads = numbers.reshape(-1, 4)
    skin = np.array(LOW) + spacing * (cells + 0.5)
    sides = np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)])
    count = np.bincount(sides[:, 0], minlength=len(skin))[:, None]
    for _ in range(20):
        mean = np.stack([np.bincount(sides[:, 0], skin[sides[:, 1], k], len(skin)) for k in range(3)], axis=1) / count
        skin += 0.7 * (mean - skin)
        for _ in range(2):
            slope = _slope(skin)
            skin -= (distance(skin) / (slope * slope).sum(axis=1))[:, None] * slope
    a, b, c, d = (skin[quads[:, k]] for k in range(4))
    short = (((a - c) ** 2).sum(axis=1) <= ((b - d) ** 2).sum(axis=1))[:, None, None]
    triangles = np.where(short, quads[:, [[0, 1, 2], [0, 2, 3]]], quads[:, [[0, 1, 3], [1, 2, 3]]]).reshape(-1, 3)
    far = np.stack([_union([part(skin) for part in parts]) for parts in _PARTS], axis=1)
    weights = np.exp(-(far - far.min(axis=1, keepdims=True)) / WEIGHT_LENGTH)
    weights /= weights.sum(axis=1, keepdims=True)
    return Figure(skin, triangles.astype(np.int32), weights)


def _turn(axis: int, angle: float, joint: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Floats:
    """Return the motion (4, 4) that turns about an axis through a joint."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    motion = np.eye(4)
    motion[u, u] = motion[v, v] = np.cos(angle)
    motion[v, u] = np.sin(angle)
    motion[u, v] = -motion[v, u]
    at = np.array(joint)
    motion[:3, 3] = at - motion[:3, :3] @ at
    return motion


def bones(time: float, swing: float = 1.0) -> Floats:
    """Return the motions of the bones at a time [s]: (bones, 3, 4), those of `Figure.moved`.

    At rest for `STILL` seconds; then it breathes, turns from the waist to both sides, steps from foot to foot, rises on
    its toes, looks around and lifts its arms a little.

    Args:
        time: [s]
        swing: Size of all these motions; 1 is usual.
    """
    t = max(time - STILL, 0.0)
    share = min(t / EASE, 1.0)
    size = swing * share**3 * (10.0 + share * (6.0 * share - 15.0))

    def to_and_fro(period: float) -> float:
        return size * float(np.sin(2.0 * np.pi * t / period))

    def up_and_down(period: float) -> float:
        return 0.5 * size * (1.0 - float(np.cos(2.0 * np.pi * t / period)))

    hips = np.eye(4)
    hips[:3, 3] = (0.0, 0.03 * to_and_fro(2.0), 0.02 * up_and_down(1.0))
    hips = hips @ _turn(0, 0.04 * to_and_fro(2.0)) @ _turn(2, 0.15 * to_and_fro(4.0))
    chest = hips @ _turn(2, 0.3 * to_and_fro(4.0), WAIST) @ _turn(1, 0.06 * to_and_fro(3.5), WAIST)
    chest = chest @ _turn(0, -0.06 * to_and_fro(2.0), WAIST)
    breath = np.diag([1.0 + 0.05 * up_and_down(3.2), 1.0 + 0.02 * up_and_down(3.2), 1.0, 1.0])
    head = chest @ _turn(2, 0.35 * to_and_fro(5.0), NECK)
    x, y, z = SHOULDER
    left = chest @ _turn(0, 0.3 * up_and_down(3.0), SHOULDER)
    right = chest @ _turn(0, -0.3 * up_and_down(2.5), (x, -y, z))
    return np.stack([hips, chest @ breath, head, left, right])[:, :3]
