"""The centreline of a thread in a photograph, from the ledge to its free end."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, label
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.photographs.ruler import Picture, Pixel
from stickslip_sim_core.splines import bspline_matrix

Mask = NDArray[np.bool_]

NOISE_BLUR = 1.0
"""Standard deviation of the Gaussian that is laid over the photograph first [px]."""

BACKGROUND_SHARE = 0.08
"""Side of the median that stands for the background, over the picture's shorter side. A thread
must be thinner than half of it.
"""

NEAR_LEDGE_SHARE = 0.02
"""Distance from the ledge within which the thread must pass, over the picture's shorter side."""

LEAST_CONTRAST = 6.0
"""Least contrast of a thread over the noise of the background."""

LEAST_LENGTH = 20.0
"""Least length of a thread over its thickness: a shorter piece is no thin rod."""

MOST_AREA = 1.6
"""Largest area of the thread over length times thickness. A ruler or a shadow that touches the
thread adds its own area.
"""

KNOT_THICKNESSES = 2.0
"""Distance of the spline's knots over the thickness: a thread does not bend more sharply."""

MOST_INTERVALS = 60
"""Largest number of knot intervals, for thin wires: each keeps a few pixels to fit."""

RIDGE_FLOOR = 0.05
"""Speed of the path at the thread's edge, over that in its middle; it keeps the path inside."""


@dataclass(frozen=True, eq=False)
class Thread:
    """A thread in a photograph."""

    points: Floats
    """Points of the centreline from the ledge to the free end, about a pixel apart: (n, 2) [px]."""

    thickness: float
    """Width of the thread at half of its contrast [px]."""

    contrast: float
    """Contrast of the thread over the noise of the background."""


def find_thread(picture: Picture, ledge: Pixel, side: int) -> Thread:
    """Find the thread that hangs from a ledge.

    Args:
        picture: The photograph, blue, green and red, (H, W, 3).
        ledge: Pixel (x, y) at which the thread leaves the ledge.
        side: 1 if the thread hangs to the right of the ledge, -1 if to the left.

    Raises:
        ValueError: The ledge is outside the picture, no thread stands out from the background
            there, it is too short, or another thing touches it.
    """
    height, width = picture.shape[:2]
    if not (0 <= ledge[0] < width and 0 <= ledge[1] < height):
        raise ValueError(
            f"ledge: must be a pixel of the photograph, x in 0 ... {width - 1} and y in 0 ... "
            f"{height - 1}, and it is {ledge}"
        )
    contrast = _contrast(picture)
    columns = np.arange(width)
    is_away = (columns - ledge[0]) * side >= 0.0
    contrast_away = np.where(is_away, contrast, 0.0)

    peak = _peak_near(contrast_away, ledge)
    noise = _noise_of(contrast[:, is_away])
    if peak < LEAST_CONTRAST * noise:
        raise ValueError(
            f"ledge: the thread must stand out from its background by {LEAST_CONTRAST:g} times "
            f"the noise, and at {ledge} it does by {peak / noise:.1f} times; give the pixel at "
            "which the thread leaves the ledge, or photograph it before a plain background"
        )
    mask = _component(contrast_away > 0.5 * peak, ledge)
    path = _ridge(mask, ledge)
    length = float(np.hypot(*np.diff(path, axis=0).T).sum())
    depth = distance_transform_edt(mask)
    columns_of_path, rows_of_path = path.astype(int).T
    # The distance to the nearest pixel outside is half a pixel more than that to the edge.
    thickness = 2.0 * float(np.median(depth[rows_of_path, columns_of_path])) - 1.0
    _refuse_no_thread(length, thickness, int(mask.sum()))
    return Thread(_centred(contrast, path, thickness), thickness, peak / noise)


def uniform_points(points: Floats, count: int) -> Floats:
    """Return points at uniform arc length along a polygon (n, d): (count, d)."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    places = np.linspace(0.0, arc[-1], count)
    return np.stack([np.interp(places, arc, column) for column in points.T], axis=1)


def _contrast(picture: Picture) -> Floats:
    """Return how much each pixel differs from its background, in CIELAB: (H, W)."""
    colour = cv2.cvtColor(cv2.GaussianBlur(picture, (0, 0), NOISE_BLUR), cv2.COLOR_BGR2LAB)
    # The side of a median must be odd.
    side = 2 * int(0.5 * BACKGROUND_SHARE * min(picture.shape[:2])) + 1
    background = cv2.medianBlur(colour, side)
    difference = colour.astype(np.float64) - background.astype(np.float64)
    return np.asarray(np.linalg.norm(difference, axis=2))


def _near(shape: tuple[int, ...], ledge: Pixel) -> Mask:
    """Return the pixels near the ledge: (H, W)."""
    rows, columns = np.indices(shape)
    distance = np.hypot(columns - ledge[0], rows - ledge[1])
    return np.asarray(distance <= max(NEAR_LEDGE_SHARE * min(shape), 2.0))


def _peak_near(contrast: Floats, ledge: Pixel) -> float:
    """Return the contrast of the thread near the ledge."""
    # The largest values may be noise, and a thin thread covers a small share of the pixels.
    values = contrast[_near(contrast.shape, ledge)]
    return float(np.quantile(values, 0.95))


def _noise_of(contrast: Floats) -> float:
    """Return the contrast that the background has by noise; at least a grey level."""
    return max(float(np.median(contrast)), 1.0)


def _component(mask: Mask, ledge: Pixel) -> Mask:
    """Return the connected part of a mask that passes the ledge."""
    labels, _ = label(mask, structure=np.ones((3, 3)))
    near = labels[_near(mask.shape, ledge) & mask]
    return np.asarray(labels == np.bincount(near).argmax())


def _ridge(mask: Mask, ledge: Pixel) -> Floats:
    """Return the path in the middle of a mask, from the ledge to the farthest end: (n, 2) [px]."""
    rows, columns = np.nonzero(mask)
    at_ledge = np.abs(columns - ledge[0]) <= np.abs(columns - ledge[0]).min()
    # The thread's cross section at the ledge: the path starts in its middle.
    middle = np.median(rows[at_ledge])
    start = int(np.flatnonzero(at_ledge)[np.argmin(np.abs(rows[at_ledge] - middle))])

    steps = _steps(mask)
    away = dijkstra(steps, indices=np.array([start]))[0]
    end = int(np.argmax(np.where(np.isfinite(away), away, -1.0)))
    # In the middle the path is quick, so it stays there.
    depth = distance_transform_edt(mask)[rows, columns]
    speed = RIDGE_FLOOR + (depth / depth.max()) ** 2
    along = steps.tocoo()
    cost = along.data * 0.5 * (1.0 / speed[along.row] + 1.0 / speed[along.col])
    weighted = csr_matrix((cost, (along.row, along.col)), shape=along.shape)
    _, before = dijkstra(weighted, indices=np.array([start]), return_predecessors=True)
    nodes = [end]
    while nodes[-1] != start:
        nodes.append(int(before[0, nodes[-1]]))
    order = np.array(nodes[::-1])
    return np.stack([columns[order], rows[order]], axis=1).astype(np.float64)


def _steps(mask: Mask) -> csr_matrix:
    """Return the graph of the pixels of a mask, with the distances of the eight neighbours [px]."""
    number = np.full(np.add(mask.shape, 2), -1)
    number[1:-1, 1:-1][mask] = np.arange(mask.sum())
    height, width = mask.shape
    here = number[1:-1, 1:-1]
    begins, ends, lengths = [], [], []
    # Each pair of neighbours once: to the right, and to three below.
    for down, right in ((0, 1), (1, 1), (1, 0), (1, -1)):
        there = number[1 + down : 1 + down + height, 1 + right : 1 + right + width]
        is_pair = (here >= 0) & (there >= 0)
        begins.append(here[is_pair])
        ends.append(there[is_pair])
        lengths.append(np.full(int(is_pair.sum()), np.hypot(down, right)))
    begin = np.concatenate(begins)
    end = np.concatenate(ends)
    length = np.concatenate(lengths)
    size = int(mask.sum())
    both = coo_matrix((np.tile(length, 2), (np.r_[begin, end], np.r_[end, begin])), (size, size))
    return both.tocsr()


def _refuse_no_thread(length: float, thickness: float, area: int) -> None:
    """Refuse what is no thread by its length and thickness [px] and area [px^2]."""
    if length < LEAST_LENGTH * thickness:
        raise ValueError(
            f"photograph: the thread must be at least {LEAST_LENGTH:g} times as long as thick, and "
            f"what begins at the ledge is {length:.0f} pixels long and {thickness:.0f} thick; give "
            "the pixel at which the thread leaves the ledge, or let a longer piece hang"
        )
    ratio = area / (length * thickness)
    if ratio > MOST_AREA:
        raise ValueError(
            "photograph: nothing may touch the thread in the picture, and what begins at the "
            f"ledge covers {ratio:.1f} times the area of a thread of {length:.0f} by "
            f"{thickness:.0f} pixels; move rulers, fuzz and shadows away from the thread"
        )


def _centred(contrast: Floats, path: Floats, thickness: float) -> Floats:
    """Return a smooth line through the middle of the thread, about a pixel apart: (n, 2) [px].

    The middle of a cross section is the mean of its pixels, weighted by contrast. A cubic spline of
    least squares through the middles leaves out their noise.
    """
    # A path of pixels has corners; without them its normals are those of the thread.
    smooth = gaussian_filter1d(path, max(thickness, 2.0), axis=0, mode="nearest")
    smooth[[0, -1]] = path[[0, -1]]
    length = float(np.hypot(*np.diff(smooth, axis=0).T).sum())
    points = uniform_points(smooth, max(int(length), 16))
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)

    offsets = np.linspace(-thickness, thickness, 2 * int(np.ceil(thickness)) + 5)
    places = points[:, None] + offsets[:, None] * normals[:, None]
    section = cv2.remap(
        contrast.astype(np.float32),
        places[..., 0].astype(np.float32),
        places[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
    ).astype(np.float64)
    # What is fainter than a quarter of the thread is background.
    weights = np.maximum(section - 0.25 * np.median(section.max(axis=1)), 0.0)
    weights += np.finfo(float).tiny
    middles = points + ((weights @ offsets) / weights.sum(axis=1))[:, None] * normals
    # A cross section at the very end is cut by it, so the end itself is that of the path.
    middles[-1] = points[-1]

    intervals = int(np.clip(length / (KNOT_THICKNESSES * thickness), 12, MOST_INTERVALS))
    basis = bspline_matrix(intervals, np.linspace(0.0, 1.0, len(middles)))
    coefficients = np.linalg.lstsq(basis, middles, rcond=None)[0]
    return np.asarray(basis @ coefficients)
