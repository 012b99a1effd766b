"""Views: the coverage of each pixel by a bright rod, and pictures of a tube about a curve.

A rod a few pixels wide is known to a tenth of a pixel only if the brightness of the pixels on its
edge is used, not just whether they are bright. So a silhouette is a coverage: the share of each
pixel that is rod.

About the projected centreline, at signed distance n from it [px], a tube of half width r has the
coverage

    c(n) = Phi((n + r) / b) - Phi((n - r) / b)     Phi the normal distribution, b the blur

and the brightness c (light + slope n / r): lamps make one side brighter, and a model without the
slope would move the centreline towards it. If two parts of the rod cross in a view, the nearer
covers the farther, I = I_1 + (1 - c_1) I_2. The free end is round. Pixels behind the clamp are left
out: whatever holds the rod may be seen there.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.interpolate import BSpline
from scipy.special import ndtr
from stickslip_schemas.spec.cameras import Camera

from stickslip_training.arrays import Floats, Integers

GROUND_DEGREE = 2  # of the polynomial in (x, y) that an unevenly lit ground follows
GROUND_SAMPLES = 20_000  # pixels that the polynomial is fitted to
NEIGHBOURHOOD = 4.0  # [px], standard deviation of the window in which the rod has one brightness
FAINTEST = (
    0.05  # of the rod's typical brightness: what is darker is ground, however quiet the ground is
)
NOISE_FACTOR = (
    6.0  # standard deviations of the ground's noise that the brightness of the rod must exceed
)
SMALLEST_PART = 0.02  # of the silhouette's area: smaller bright spots are dirt
DEGREE = 3
BAND = 2.5  # blurs beyond the edge of the rod that are looked at


class ReconstructionError(ValueError):
    """The views are not enough for a reconstruction; the message names the view."""


def silhouette(light: Floats) -> Floats:
    """Return the coverage (y, x) in a picture of linear light (y, x, channel).

    It is 0 on the ground, about 1 on the rod, and in between on its edge.

    The ground must be darker than the rod but need not be evenly so; the colour of the rod is
    found. Coverage is relative to the brightness of the rod around the pixel, and may exceed 1
    where the rod shines.
    """
    light = light - _ground(light)
    luminance = light.sum(axis=2).clip(0.0)
    color = np.einsum(
        "yxc,yx->c", light, luminance**2
    )  # of the rod, whose pixels outweigh the ground's by far
    signal = light @ (
        color / max(float(np.linalg.norm(color)), 1e-12)
    )  # the ground's noise counts least along it
    noise = 1.4826 * float(np.median(np.abs(signal - np.median(signal))))
    typical = float(
        np.sum(signal.clip(0) ** 2) / max(np.sum(signal.clip(0)), 1e-12)
    )  # weighted by itself: the rod's
    floor = max(NOISE_FACTOR * noise, FAINTEST * typical)
    if typical < 2.0 * NOISE_FACTOR * noise or typical < 1e-3:
        raise ReconstructionError(
            "image must show a rod brighter than its ground; the brightest stands out by "
            f"{typical:.3g} of linear "
            f"light, noise {noise:.3g}"
        )
    bright = np.where(signal > 0.5 * floor, signal, 0.0)
    local = ndimage.gaussian_filter(bright**2, NEIGHBOURHOOD) / (
        ndimage.gaussian_filter(bright, NEIGHBOURHOOD) + 1e-6 * typical
    )
    coverage = signal.clip(0.0) / np.maximum(local, floor)
    return np.where(_large_parts(coverage > 0.5), coverage, 0.0)


def to_linear(image: npt.ArrayLike) -> Floats:
    """Decode sRGB [IEC 61966-2-1] to linear light (y, x, channel).

    Pixels have 8 or 16 bits, or are floating numbers in [0, 1].
    """
    pixels = np.asarray(image)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3):
        raise ValueError(
            f"image must have shape (y, x), (y, x, 1) or (y, x, 3); got {np.shape(image)}"
        )
    scale = float(np.iinfo(pixels.dtype).max) if np.issubdtype(pixels.dtype, np.integer) else 1.0
    encoded = pixels.astype(np.float64) / scale
    if not np.isfinite(encoded).all():
        raise ValueError("image must be finite")
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded.clip(0) + 0.055) / 1.055) ** 2.4)


def _ground(light: Floats) -> Floats:
    """Fit the ground by a polynomial, leaving out, again and again, all that is brighter."""
    height, width, channels = light.shape
    step = max(1, int(np.sqrt(height * width / GROUND_SAMPLES)))
    x = np.linspace(-1.0, 1.0, width)
    y = np.linspace(-1.0, 1.0, height)
    powers = [(i, j) for i in range(GROUND_DEGREE + 1) for j in range(GROUND_DEGREE + 1 - i)]
    grid_y, grid_x = np.meshgrid(y[::step], x[::step], indexing="ij")
    basis = np.stack([(grid_y**i * grid_x**j).ravel() for i, j in powers], axis=1)
    values = light[::step, ::step].reshape(-1, channels)
    luminance = values.mean(axis=1)
    ground = luminance <= np.quantile(luminance, 0.7)
    for _ in range(4):
        coefficients = np.linalg.lstsq(basis[ground], values[ground], rcond=None)[0]
        excess = luminance - (basis @ coefficients).mean(axis=1)
        spread = 1.4826 * np.median(np.abs(excess[ground])) + 1e-4
        ground = np.abs(excess) < 4.0 * spread
    fitted = np.zeros_like(light)
    for (i, j), coefficient in zip(powers, coefficients, strict=True):
        fitted += (y[:, None] ** i * x**j)[..., None] * coefficient
    return fitted


def _large_parts(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Keep the surroundings of the large connected parts of a mask."""
    labels, count = ndimage.label(mask, structure=np.ones((3, 3)))
    areas = np.bincount(labels.ravel(), minlength=count + 1)
    areas[0] = 0
    large = areas > SMALLEST_PART * areas.sum()
    return np.asarray(ndimage.binary_dilation(large[labels], iterations=3))


@dataclass(frozen=True, slots=True)
class View:
    """View of the rod by one camera, and the projection u = f (R x + t)_xy / depth + c."""

    name: str
    coverage: Floats
    """Share of each pixel that is rod, (height, width)."""
    R: Floats
    """World to camera, (3, 3)."""
    t: Floats
    """The clamp in camera coordinates [L], (3,)."""
    f: Floats
    """Focal lengths along a row and along a column [px], (2,)."""
    c: Floats
    """Principal point, column and row [px], (2,)."""

    @classmethod
    def of(
        cls,
        camera: Camera,
        coverage: Floats,
        *,
        length: float,
        clamp: npt.ArrayLike,
        factor: int = 1,
    ) -> Self:
        """Bring a camera to the rod's units.

        The picture has been shrunk by a factor before its coverage was found.
        """
        R = np.asarray(camera.rotation)
        return cls(
            name=camera.name,
            coverage=coverage,
            R=R,
            t=(R @ np.asarray(clamp, dtype=np.float64) + np.asarray(camera.translation)) / length,
            f=np.array([camera.fx, camera.fy]) / factor,
            c=(np.array([camera.cx, camera.cy]) + 0.5) / factor - 0.5,
        )

    def shrunk(self, factor: int) -> Self:
        """Return the same view in pixels that are larger."""
        c = (self.c + 0.5) / factor - 0.5
        return replace(self, coverage=shrink_image(self.coverage, factor), f=self.f / factor, c=c)

    @property
    def focal(self) -> float:
        """The focal length that turns a radius over depth into pixels [px]."""
        return float(np.sqrt(self.f[0] * self.f[1]))

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Return pixels (..., 2) and depths (...) [L] of points (..., 3)."""
        x = points @ self.R.T + self.t
        depth = np.maximum(x[..., 2], 1e-6)
        return self.f * x[..., :2] / depth[..., None] + self.c, depth

    def gradient(self, points: Floats) -> Floats:
        """Return d pixel / d point, (..., 2, 3): f (R_xy - (x, y) / z R_z) / z."""
        x = points @ self.R.T + self.t
        depth = np.maximum(x[..., 2], 1e-6)[..., None, None]
        slope = (x[..., :2, None] / depth) * self.R[2]
        return np.asarray(self.f[:, None] * (self.R[:2] - slope) / depth)


def shrink_image(image: Floats, factor: int) -> Floats:
    """Average blocks of pixels of (y, x) or (y, x, channel).

    The rest at the right and at the bottom is dropped.
    """
    height, width = (n // factor * factor for n in image.shape[:2])
    blocks = image[:height, :width].reshape(
        height // factor, factor, width // factor, factor, *image.shape[2:]
    )
    return np.asarray(blocks.mean(axis=(1, 3)))


# --- curves: cubic B-splines over [0, 1] with evenly spaced knots, (K, 3) control points
# ----------------------


def basis(s: Floats, count: int, derivative: int = 0) -> Floats:
    """Return B, (n, count): B @ control points are the points, or the derivatives, at s, (n,)."""
    inner = np.linspace(0.0, 1.0, count - DEGREE + 1)
    knots = np.concatenate(
        [np.zeros(DEGREE), inner, np.ones(DEGREE)]
    )  # the ends are the first and the last point
    return np.asarray(BSpline(knots, np.eye(count), DEGREE)(s, nu=derivative))


def fit_curve(points: Floats, count: int) -> Floats:
    """Return the control points (count, 3) of the spline nearest to a polyline (n, 3).

    The spline's parameter runs from 0 to 1 whatever the polyline's length.
    """
    s = arc_length(points)
    dense = np.linspace(0.0, s[-1], 4 * count)
    sampled = np.stack([np.interp(dense, s, axis) for axis in points.T], axis=1)
    B = basis(np.linspace(0.0, 1.0, len(dense)), count)
    smooth = 1e-2 * np.diff(np.eye(count), 3, axis=0)
    control: Floats = np.linalg.lstsq(
        np.vstack([B, smooth]), np.vstack([sampled, np.zeros((count - 3, 3))])
    )[0]
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


# --- tubes
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Side:
    """The nearer or the farther part of the rod at each pixel; rows if there is none are zero."""

    sample: Integers
    """Sample of the curve nearest to the pixel, (n,)."""
    by_light: Floats
    """d I / d light, (n,); c if nothing is in front."""
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


def tube_image(
    view: View, points: Floats, radius: float, blur: float, light: Floats, slope: Floats
) -> TubeImage:
    """Draw the tube about samples (n, 3) of a curve, half a pixel apart or less.

    Radius [L], blur [px].

    `light` is the brightness in the middle at the samples, (n,), and `slope` its gain from
    there to the edge.
    """
    pixels, depth = view.project(points)
    half = radius * view.focal / depth
    pixel, sample = _passes(pixels, half + BAND * blur, view.coverage.shape)
    tangent = np.gradient(pixels, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True) + 1e-9
    offset = (
        np.stack([pixel % view.coverage.shape[1], pixel // view.coverage.shape[1]], axis=1)
        - pixels[sample]
    )
    along = np.sum(offset * tangent[sample], axis=1)
    normal = np.stack([-tangent[sample, 1], tangent[sample, 0]], axis=1)
    beyond = (sample == len(points) - 1) & (along > 0.0)
    distance = np.linalg.norm(offset, axis=1)
    normal[beyond] = offset[beyond] / np.maximum(distance[beyond, None], 1e-9)
    n = np.sum(offset * normal, axis=1)
    r = half[sample]

    high = (n + r) / blur
    low = (n - r) / blur
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
    """Pair each pixel with the nearest sample of every part of the curve within reach."""
    span = int(np.ceil(reach.max())) + 1
    x, y = (axis.ravel() for axis in np.mgrid[-span : span + 1, -span : span + 1])
    disc = x**2 + y**2 <= (span + 0.5) ** 2
    nearest = np.rint(pixels).astype(np.int64)
    x = nearest[:, :1] + x[disc]
    y = nearest[:, 1:] + y[disc]
    apart = (x - pixels[:, :1]) ** 2 + (y - pixels[:, 1:]) ** 2
    height, width = shape
    near = np.flatnonzero(
        (apart <= reach[:, None] ** 2) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    )
    sample = near // x.shape[1]
    pixel = y.ravel()[near] * width + x.ravel()[near]
    order = np.argsort(pixel * len(pixels) + sample)  # no two are equal
    pixel = pixel[order]
    sample = sample[order]
    distance = apart.ravel()[near][order]
    if len(pixel) == 0:
        return pixel, sample
    starts = np.flatnonzero(np.concatenate([[True], (np.diff(pixel) != 0) | (np.diff(sample) > 1)]))
    least = np.repeat(np.minimum.reduceat(distance, starts), np.diff(np.append(starts, len(pixel))))
    candidate = np.where(distance == least, np.arange(len(pixel)), len(pixel))
    first = np.minimum.reduceat(candidate, starts)
    return pixel[first], sample[first]


def _compose(
    pixel: Integers, part: Side, value: Floats, depth: Floats, left_out: npt.NDArray[np.bool_]
) -> TubeImage:
    """Let the nearest part at each pixel cover the next; a third and more are not seen."""
    order = np.lexsort((depth, pixel))
    first = (
        np.flatnonzero(np.concatenate([[True], np.diff(pixel[order]) != 0]))
        if len(order)
        else order
    )
    front = order[first]
    last = np.append(first[1:], len(order)) - 1
    has_back = last > first
    back = order[np.where(has_back, first + 1, first)]
    is_front = ~left_out[front] & ~(left_out[back] & has_back)
    hidden = pixel[front[~is_front]]
    front = front[is_front]
    back = back[is_front]
    has_light = has_back[is_front].astype(np.float64)
    through = has_light * (1.0 - part.by_light[front])
    # The front's own derivatives act on I_1 (1 - I_2 c_1 / I_1): its light does not change what it
    # covers.
    lost = (
        has_light
        * value[back]
        * np.divide(
            part.by_light[front], value[front], out=np.zeros(len(front)), where=value[front] > 1e-6
        )
    )
    return TubeImage(
        pixel=pixel[front],
        value=value[front] + through * value[back],
        sides=(
            _scaled(part, front, np.ones(len(front)), 1.0 - lost),
            _scaled(part, back, through, through),
        ),
        left_out=hidden,
    )


def _scaled(part: Side, rows: Integers, by_light: Floats, by_shape: Floats) -> Side:
    factors = {"by_light": by_light, "by_slope": by_light}
    factors |= {
        "by_point": by_shape[:, None],
        "by_normal": by_shape,
        "by_radius": by_shape,
        "by_blur": by_shape,
    }
    scaled = {name: getattr(part, name)[rows] * factor for name, factor in factors.items()}
    return Side(part.sample[rows], **scaled)
