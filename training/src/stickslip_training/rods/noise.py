"""Noise of a reconstructed centreline."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stickslip_training.arrays import AnyFloats, SingleFloats


def with_white_noise(centerline: AnyFloats, share: float, seed: tuple[int, ...]) -> SingleFloats:
    """Add independent normal noise of standard deviation `share` (of L) to every coordinate of every point.

    The same `seed` gives the same noise. `centerline` is over L, (..., points, 3).
    """
    generator = np.random.default_rng(seed)
    noise = generator.standard_normal(centerline.shape, dtype=np.float32)
    return (centerline + np.float32(share) * noise).astype(np.float32, copy=False)


@dataclass(frozen=True, eq=False)
class ReconstructionNoise:
    """What a reconstruction from pictures does to a centreline: correlated along the rod, and largest at its end."""

    errors: SingleFloats
    """Reconstructed less true centrelines [L], (rods, points, 3), of rods like those that it is meant for."""

    @staticmethod
    def load(path: str | Path) -> "ReconstructionNoise":
        """Read what `benchmarks/reconstruction.py --save` wrote; rods that the reconstruction flagged are left out."""
        with np.load(path) as file:
            good = file["verdict"] == "good"
            return ReconstructionNoise((file["reconstructed"] - file["true"])[good].astype(np.float32))

    def draw(self, count: int, generator: np.random.Generator) -> SingleFloats:
        """Return `count` new errors, (count, points, 3).

        Each is the mean, plus a cos(x) + b sin(x) of the deviations a, b of two measured errors and a random angle x:
        new, with the mean and the covariance of those measured.
        """
        mean = self.errors.mean(axis=0)
        a, b = self.errors[generator.integers(len(self.errors), size=(2, count))] - mean
        angle = generator.uniform(0.0, 2.0 * np.pi, (count, 1, 1))
        return np.asarray(mean + np.cos(angle) * a + np.sin(angle) * b, dtype=np.float32)
