"""A silhouette with its camera, in the rod's own units: the clamp is the origin and the rod's length is 1."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

from stickslip_training.arrays import Floats


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
        gradient: Floats = self.f[:, None] * (self.R[:2] - slope) / depth
        return gradient


def shrink_image(image: Floats, factor: int) -> Floats:
    """Average blocks of pixels of (y, x) or (y, x, channel); the rest at the right and at the bottom is dropped."""
    height, width = (n // factor * factor for n in image.shape[:2])
    blocks = image[:height, :width].reshape(height // factor, factor, width // factor, factor, *image.shape[2:])
    mean: Floats = blocks.mean(axis=(1, 3))
    return mean
