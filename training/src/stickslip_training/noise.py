"""Noise of a reconstructed centreline."""

import numpy as np
import numpy.typing as npt


def with_white_noise(
    centerline: npt.NDArray[np.floating], share: float, seed: tuple[int, ...]
) -> npt.NDArray[np.float32]:
    """Add independent normal noise of standard deviation `share` (of L) to every coordinate of every point.

    The same `seed` gives the same noise. `centerline` is over L, (..., points, 3).
    """
    generator = np.random.default_rng(seed)
    noise = generator.standard_normal(centerline.shape, dtype=np.float32)
    return (centerline + np.float32(share) * noise).astype(np.float32, copy=False)
