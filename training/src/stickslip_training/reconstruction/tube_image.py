"""What a camera sees of a tube about a curve, and how that changes when the tube does.

Curves are cubic B-splines over [0, 1] with evenly spaced knots, (K, 3) control points.

About the projected centreline, at signed distance n from it [px], a tube of half width r has the coverage

    c(n) = Phi((n + r) / b) - Phi((n - r) / b)          Phi the normal distribution, b the blur of the picture

and the brightness c (light + slope n / r): lamps make one side brighter, and a model without the slope would move the
centreline towards it. Where two parts of the rod cross in a view, the nearer covers the farther,
I = I_1 + (1 - c_1) I_2. The free end is round. Pixels behind the clamp are left out: whatever holds the rod may be seen
there.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline
from scipy.special import ndtr

from stickslip_training.arrays import Floats, Integers
from stickslip_training.reconstruction.silhouette import View

DEGREE = 3
BAND = 2.5  # blurs beyond the edge of the rod that are looked at


def basis(s: Floats, count: int, derivative: int = 0) -> Floats:
    """Return B, (n, count): B @ control points are the points, or the derivatives, at s, (n,)."""
    inner = np.linspace(0.0, 1.0, count - DEGREE + 1)
    knots = np.concatenate([np.zeros(DEGREE), inner, np.ones(DEGREE)])  # the ends are the first and the last point
    return np.asarray(BSpline(knots, np.eye(count), DEGREE)(s, nu=derivative))


def fit_curve(points: Floats, count: int) -> Floats:
    """Return the control points (count, 3) of the spline nearest to a polyline (n, 3), by its arc length.

    The spline's parameter runs from 0 to 1 whatever the polyline's length.
    """
    s = arc_length(points)
    dense = np.linspace(0.0, s[-1], 4 * count)
    sampled = np.stack([np.interp(dense, s, axis) for axis in points.T], axis=1)
    B = basis(np.linspace(0.0, 1.0, len(dense)), count)
    smooth = 1e-2 * np.diff(np.eye(count), 3, axis=0)
    control: Floats = np.linalg.lstsq(np.vstack([B, smooth]), np.vstack([sampled, np.zeros((count - 3, 3))]))[0]
    return control


def arc_length(points: Floats) -> Floats:
    """Return the length of the polyline (n, 3) up to each of its points, (n,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def at_uniform_arc_length(control: Floats, count: int) -> Floats:
    """Return `count` points of a spline, evenly spaced along its length, ends included."""
    parameter = np.linspace(0.0, 1.0, 20 * len(control))
    length = arc_length(basis(parameter, len(control)) @ control)
    wanted = np.interp(np.linspace(0.0, length[-1], count), length, parameter)
    return np.asarray(basis(wanted, len(control)) @ control)


@dataclass(frozen=True, slots=True)
class Side:
    """The nearer or the farther part of the rod at each pixel; rows if there is none are zero."""

    sample: Integers
    """Sample of the curve nearest to the pixel, (n,)."""
    by_light: Floats
    """d I / d light, (n,); c where nothing is in front."""
    by_slope: Floats
    """d I / d slope, (n,)."""
    by_point: Floats
    """d I / d sample's position, (n, 3)."""
    by_normal: Floats
    """d I / d a shift of the picture's centreline to the side [px], (n,)."""
    by_radius: Floats
    """d I / d log radius, (n,)."""
    by_blur: Floats
    """d I / d log blur, (n,)."""


@dataclass(frozen=True, slots=True)
class TubeImage:
    """The pixels near the rod."""

    pixel: Integers
    """Index y width + x, (n,), each pixel once."""
    value: Floats
    """I, (n,)."""
    sides: tuple[Side, Side]
    """The nearer and the farther part."""
    left_out: Integers
    """Pixels near the rod, but behind the clamp."""


def tube_image(view: View, points: Floats, radius: float, blur: float, light: Floats, slope: Floats) -> TubeImage:
    """Draw the tube about samples (n, 3) of a curve, half a pixel apart or less; radius [L], blur [px].

    `light` is the brightness in the middle at the samples, (n,), and `slope` what it gains from there to the edge.
    """
    pixels, depth = view.project(points)
    half = radius * view.focal / depth
    pixel, sample = _passes(pixels, half + BAND * blur, view.coverage.shape)
    tangent = np.gradient(pixels, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True) + 1e-9
    offset = np.stack([pixel % view.coverage.shape[1], pixel // view.coverage.shape[1]], axis=1) - pixels[sample]
    along = np.sum(offset * tangent[sample], axis=1)
    normal = np.stack([-tangent[sample, 1], tangent[sample, 0]], axis=1)
    beyond = (sample == len(points) - 1) & (along > 0.0)
    distance = np.linalg.norm(offset, axis=1)
    normal[beyond] = offset[beyond] / np.maximum(distance[beyond, None], 1e-9)
    n, r = np.sum(offset * normal, axis=1), half[sample]

    high, low = (n + r) / blur, (n - r) / blur
    density_high, density_low = (np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi) for x in (high, low))
    covered = ndtr(high) - ndtr(low)
    tilt = np.where(beyond, 0.0, np.clip(n / r, -1.5, 1.5))
    bright = light[sample] + slope[sample] * tilt
    by_n = (density_high - density_low) / blur * bright
    tilting = covered * slope[sample] * (~beyond & (np.abs(n) < 1.5 * r))
    by_n += tilting / r
    part = Side(
        sample=sample,
        by_light=covered,
        by_slope=covered * tilt,
        by_point=-by_n[:, None] * np.einsum("ij,ijk->ik", normal, view.gradient(points)[sample]),
        by_normal=-by_n,
        by_radius=(density_high + density_low) * r / blur * bright - tilting * n / r,
        by_blur=(density_low * low - density_high * high) * bright,
    )
    behind_clamp = (sample == 0) & (along < 0.0)
    return _compose(pixel, part, covered * bright, depth[sample], behind_clamp)


def _passes(pixels: Floats, reach: Floats, shape: tuple[int, ...]) -> tuple[Integers, Integers]:
    """Pair each pixel with the nearest sample of every part of the curve that passes it within reach."""
    span = int(np.ceil(reach.max())) + 1
    x, y = (axis.ravel() for axis in np.mgrid[-span : span + 1, -span : span + 1])
    disc = x**2 + y**2 <= (span + 0.5) ** 2
    nearest = np.rint(pixels).astype(np.int64)
    x, y = nearest[:, :1] + x[disc], nearest[:, 1:] + y[disc]
    apart = (x - pixels[:, :1]) ** 2 + (y - pixels[:, 1:]) ** 2
    height, width = shape
    found = np.flatnonzero((apart <= reach[:, None] ** 2) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
    sample = found // x.shape[1]
    pixel = y.ravel()[found] * width + x.ravel()[found]
    order = np.argsort(pixel * len(pixels) + sample)  # no two are equal
    pixel, sample, distance = pixel[order], sample[order], apart.ravel()[found][order]
    if len(pixel) == 0:
        return pixel, sample
    starts = np.flatnonzero(np.concatenate([[True], (np.diff(pixel) != 0) | (np.diff(sample) > 1)]))
    least = np.repeat(np.minimum.reduceat(distance, starts), np.diff(np.append(starts, len(pixel))))
    candidate = np.where(distance == least, np.arange(len(pixel)), len(pixel))
    first = np.minimum.reduceat(candidate, starts)
    return pixel[first], sample[first]


def _compose(pixel: Integers, part: Side, value: Floats, depth: Floats, left_out: npt.NDArray[np.bool_]) -> TubeImage:
    """Let the nearest part at each pixel cover the next; a third and more are not seen."""
    order = np.lexsort((depth, pixel))
    first = np.flatnonzero(np.concatenate([[True], np.diff(pixel[order]) != 0])) if len(order) else order
    front = order[first]
    last = np.append(first[1:], len(order)) - 1
    has_back = last > first
    back = order[np.where(has_back, first + 1, first)]
    kept = ~left_out[front] & ~(left_out[back] & has_back)
    hidden = pixel[front[~kept]]
    front, back, seen = front[kept], back[kept], has_back[kept].astype(np.float64)
    through = seen * (1.0 - part.by_light[front])
    # The front's own derivatives act on I_1 (1 - I_2 c_1 / I_1): its light does not change what it covers.
    lost = (
        seen
        * value[back]
        * np.divide(part.by_light[front], value[front], out=np.zeros(len(front)), where=value[front] > 1e-6)
    )
    return TubeImage(
        pixel=pixel[front],
        value=value[front] + through * value[back],
        sides=(_scaled(part, front, np.ones(len(front)), 1.0 - lost), _scaled(part, back, through, through)),
        left_out=hidden,
    )


def _scaled(part: Side, rows: Integers, by_light: Floats, by_shape: Floats) -> Side:
    factors = {"by_light": by_light, "by_slope": by_light}
    factors |= {"by_point": by_shape[:, None], "by_normal": by_shape, "by_radius": by_shape, "by_blur": by_shape}
    scaled = {name: getattr(part, name)[rows] * factor for name, factor in factors.items()}
    return Side(part.sample[rows], **scaled)
