"""Tell a bright rod from a dark ground, with fractions of pixels.

A rod a few pixels wide is known to a tenth of a pixel only if the brightness of the pixels on its edge is used, not
just whether they are bright. So a silhouette is a coverage: the share of each pixel that is rod.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from stickslip_schemas.spec.cameras import Camera

from stickslip_training.arrays import Floats

GROUND_DEGREE = 2  # of the polynomial in (x, y) that an unevenly lit ground follows
GROUND_SAMPLES = 20_000  # pixels that the polynomial is fitted to
NEIGHBOURHOOD = 4.0  # [px], standard deviation of the window in which the rod has one brightness
FAINTEST = 0.05  # of the rod's typical brightness: what is darker is ground, however quiet the ground is
NOISE_FACTOR = 6.0  # standard deviations of the ground's noise that the brightness of the rod must exceed
SMALLEST_PART = 0.02  # of the silhouette's area: smaller bright spots are dirt


class ReconstructionError(ValueError):
    """The views do not hold what a reconstruction needs; the message names the view."""


def silhouette(light: Floats) -> Floats:
    """Return the coverage (y, x) in a picture of linear light (y, x, channel): 0 on the ground, about 1 on the rod, in
    between on its edge.

    The ground must be darker than the rod but need not be evenly so; the colour of the rod is found. Coverage is
    relative to the brightness of the rod around the pixel, and may exceed 1 where the rod shines.
    """
    light = light - _ground(light)
    signal = _along_color(light)
    noise = 1.4826 * float(np.median(np.abs(signal - np.median(signal))))
    typical = float(np.sum(signal.clip(0) ** 2) / max(np.sum(signal.clip(0)), 1e-12))  # weighted by itself: the rod's
    floor = max(NOISE_FACTOR * noise, FAINTEST * typical)
    if typical < 2.0 * NOISE_FACTOR * noise or typical < 1e-3:
        raise ReconstructionError(
            f"image must show a rod brighter than its ground; the brightest stands out by {typical:.3g} of linear "
            f"light, noise {noise:.3g}"
        )
    bright = np.where(signal > 0.5 * floor, signal, 0.0)
    local = ndimage.gaussian_filter(bright**2, NEIGHBOURHOOD) / (
        ndimage.gaussian_filter(bright, NEIGHBOURHOOD) + 1e-6 * typical
    )
    coverage = signal.clip(0.0) / np.maximum(local, floor)
    return np.where(_large_parts(coverage > 0.5), coverage, 0.0)


def to_linear(image: npt.ArrayLike) -> Floats:
    """Decode sRGB [IEC 61966-2-1], 8 or 16 bit or floating numbers in [0, 1], to linear light (y, x, channel)."""
    pixels = np.asarray(image)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3):
        raise ValueError(f"image must have shape (y, x), (y, x, 1) or (y, x, 3); got {np.shape(image)}")
    scale = float(np.iinfo(pixels.dtype).max) if np.issubdtype(pixels.dtype, np.integer) else 1.0
    encoded = pixels.astype(np.float64) / scale
    if not np.isfinite(encoded).all():
        raise ValueError("image must be finite")
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded.clip(0) + 0.055) / 1.055) ** 2.4)


def _ground(light: Floats) -> Floats:
    """Fit the ground by a polynomial, leaving out, again and again, what is brighter than it."""
    height, width, channels = light.shape
    step = max(1, int(np.sqrt(height * width / GROUND_SAMPLES)))
    x, y = np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height)
    powers = [(i, j) for i in range(GROUND_DEGREE + 1) for j in range(GROUND_DEGREE + 1 - i)]
    grid_y, grid_x = np.meshgrid(y[::step], x[::step], indexing="ij")
    some = np.stack([(grid_y**i * grid_x**j).ravel() for i, j in powers], axis=1)
    values = light[::step, ::step].reshape(-1, channels)
    luminance = values.mean(axis=1)
    ground = luminance <= np.quantile(luminance, 0.7)
    for _ in range(4):
        coefficients = np.linalg.lstsq(some[ground], values[ground], rcond=None)[0]
        excess = luminance - (some @ coefficients).mean(axis=1)
        spread = 1.4826 * np.median(np.abs(excess[ground])) + 1e-4
        ground = np.abs(excess) < 4.0 * spread
    fitted = np.zeros_like(light)
    for (i, j), coefficient in zip(powers, coefficients, strict=True):
        fitted += (y[:, None] ** i * x**j)[..., None] * coefficient
    return fitted


def _along_color(light: Floats) -> Floats:
    """Project light (y, x, channel) on the direction of the rod's colour: the ground's noise counts least there."""
    luminance = light.sum(axis=2).clip(0.0)
    color = np.einsum("yxc,yx->c", light, luminance**2)  # the rod's pixels outweigh the ground's by far
    return np.asarray(light @ (color / max(float(np.linalg.norm(color)), 1e-12)))


def _large_parts(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Keep the surroundings of the large connected parts of a mask."""
    labels, count = ndimage.label(mask, structure=np.ones((3, 3)))
    areas = np.bincount(labels.ravel(), minlength=count + 1)
    areas[0] = 0
    large = areas > SMALLEST_PART * areas.sum()
    return np.asarray(ndimage.binary_dilation(large[labels], iterations=3))


@dataclass(frozen=True, slots=True)
class View:
    """What one camera saw of the rod, and how points of the rod come to its pixels: u = f (R x + t)_xy / depth + c."""

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
    def of(cls, camera: Camera, coverage: Floats, *, length: float, clamp: npt.ArrayLike, factor: int = 1) -> Self:
        """Bring a camera to the rod's units; the picture has been shrunk by a factor before its coverage was found."""
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
    """Average blocks of pixels of (y, x) or (y, x, channel); the rest at the right and at the bottom is dropped."""
    height, width = (n // factor * factor for n in image.shape[:2])
    blocks = image[:height, :width].reshape(height // factor, factor, width // factor, factor, *image.shape[2:])
    return np.asarray(blocks.mean(axis=(1, 3)))
