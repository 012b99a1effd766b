"""What a clip can tell without learning: fits to what lies between known runs.

The known runs of a fabric that landed on one side are a curve over mu in the space of what is observed. Between two
neighbours it is taken to be straight, and an observation x, of noise sigma, gives

    p(m, mu | x) ~ sum over sides of exp(-|x - f(m, side, mu)|^2 / (2 sigma^2))

The **oracle** observes the vertices themselves, in pixels: no network can do better than that with the same noise. The
fit of **silhouettes** observes only where there is cloth: a baseline that needs no training.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from stickslip_schemas.spec.cameras import Camera

from stickslip_training.arrays import Floats, Integers
from stickslip_training.cloth.crop import Cameras, holder_crops
from stickslip_training.cloth.posterior import MU_BINS, Bins, Posterior
from stickslip_training.cloth.render import splat_meshes
from stickslip_training.cloth.runs import Runs
from stickslip_training.cloth.training import INSTANTS, Clips, frames_at

LARGEST_GAP = 0.4
"""In mu: nothing is said between known runs that are farther apart."""


@dataclass(frozen=True, eq=False)
class Curves:
    """Known observations, interpolated at the middle of every bin of mu."""

    materials: tuple[str, ...]
    bins: Bins
    features: Floats
    """(materials, 2 sides, bins, n); NaN where no two runs enclose a bin."""

    @staticmethod
    def through(features: Floats, runs: Runs, bins: Bins = MU_BINS) -> "Curves":
        """Return the curves through the features, (runs, n), of known runs."""
        count = len(runs.materials)
        table = np.full((count, 2, bins.count, features.shape[1]), np.nan)
        for code in range(count):
            for place, side in enumerate((-1, 1)):
                known = np.flatnonzero((runs.material == code) & (runs.landed == side))
                known = known[np.argsort(runs.mu[known], kind="stable")]
                for a, b in pairwise(known):
                    low, high = runs.mu[a], runs.mu[b]
                    inside = (bins.centers >= low) & (bins.centers <= high)
                    if 0 < high - low <= LARGEST_GAP and inside.any():
                        share = ((bins.centers[inside] - low) / (high - low))[:, None]
                        table[code, place, inside] = (1 - share) * features[a] + share * features[b]
        return Curves(runs.materials, bins, table)

    def distances(self, observed: Floats) -> Floats:
        """Return |x - f|^2 of observations (clips, n), (clips, materials, 2, bins); infinite where there is no
        curve."""
        known = np.isfinite(self.features[..., 0])
        f = self.features[known]
        squares = np.square(observed).sum(axis=1)[:, None] + np.square(f).sum(axis=1) - 2 * observed @ f.T
        out = np.full((len(observed), *known.shape), np.inf)
        out[:, known] = np.maximum(squares, 0.0)
        return out

    def posterior(self, observed: Floats, variance: float) -> Posterior:
        """Return the posterior of observations (clips, n) with noise of `variance` in each of the n."""
        return self._posterior(self.distances(observed), variance)

    def _posterior(self, distances: Floats, variance: float) -> Posterior:
        exponents = -distances / (2.0 * variance)
        weights = np.exp(exponents - exponents.max(axis=(1, 2, 3), keepdims=True)).sum(axis=2)
        return Posterior(self.materials, self.bins, weights / weights.sum(axis=(1, 2), keepdims=True))

    def fitted_variance(self, observed: Floats, material: Integers, mu: Floats) -> float:
        """Return the variance at which known answers are the most likely; that of features that err together is
        large."""
        distances = self.distances(observed)
        least = float(np.median(distances.min(axis=(1, 2, 3)))) / observed.shape[1]
        tried = max(least, 1e-12) * np.geomspace(0.3, 3000.0, 40)
        likely = [self._posterior(distances, v).log_likelihood(material, mu).mean() for v in tried]
        return float(tried[int(np.argmax(likely))])


# --- the oracle -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Observation:
    """How vertices are seen."""

    noise: float = 0.5
    """Standard deviation of each vertex [px of the camera]."""
    shift: float = 0.0
    """Standard deviation of where the camera points [px]."""
    scale: float = 0.0
    """Standard deviation of the camera's scale [1]."""
    registered: bool = True
    """The two holder corners, seen with the same noise, are put where the camera says they are."""


def tracks(runs: Runs, camera: Camera, wanted: tuple[int, ...] = INSTANTS) -> Floats:
    """Return the vertices of runs in the pictures of a camera at the instants `wanted`, (runs, frames, vertices, 2)
    [px]."""
    frames, _ = frames_at(runs.instants, wanted)
    cameras = Cameras.of([camera] * len(runs))
    pixels, _ = cameras.project(torch.from_numpy(runs.positions[:, frames]))
    return np.asarray(pixels.flatten(2, 3).numpy(), dtype=np.float64)


def oracle(
    known: Runs,
    test: Runs,
    camera: Camera,
    seen: Observation,
    seed: int,
    wanted: tuple[int, ...] = INSTANTS,
    bins: Bins = MU_BINS,
) -> Posterior:
    """Return what the vertices of `test`, seen by `camera` at the instants `wanted` as `seen` says, tell of material
    and mu."""
    x = tracks(test, camera, wanted)
    random = np.random.default_rng((seed, 7))
    observed = x + seen.noise * random.standard_normal(x.shape)
    middle = np.array([camera.cx, camera.cy])
    factor = 1.0 + seen.scale * random.standard_normal((len(x), 1, 1, 1))
    observed = (observed - middle) * factor + middle + seen.shift * random.standard_normal((len(x), 1, 1, 2))
    if seen.registered:
        side = test.side
        corners = [side * (side - 1), side * side - 1]
        observed = _registered(observed, observed[:, :, corners], x[:, :, corners])
    curves = Curves.through(tracks(known, camera, wanted).reshape(len(known), -1), known, bins)
    # The registration's error is shared by all vertices of a frame, and so is the interpolation's: the noise is not
    # all.
    variance = seen.noise**2 + (seen.noise**2 / 2 if seen.registered else 0.0) + 0.1**2
    return curves.posterior(observed.reshape(len(x), -1), variance)


def _registered(points: Floats, found: Floats, expected: Floats) -> Floats:
    """Move points (runs, frames, n, 2) by the similarity of all frames that puts two corners where they should be.

    Least squares over the frames of a run: one scale and turn, and one shift, for the camera does not move.
    """
    z, w = (pair[..., 0] + 1j * pair[..., 1] for pair in (found, expected))
    z_mean, w_mean = (pair.mean(axis=(1, 2), keepdims=True) for pair in (z, w))
    factor = (np.conj(z - z_mean) * (w - w_mean)).sum(axis=(1, 2)) / (np.abs(z - z_mean) ** 2).sum(axis=(1, 2))
    moved = factor[:, None, None] * (points[..., 0] + 1j * points[..., 1] - z_mean) + w_mean
    return np.stack([moved.real, moved.imag], axis=-1)


# --- silhouettes ----------------------------------------------------------------------------------------------


def silhouette_fit(known: Runs, validation: Clips, clips: Clips, cameras: tuple[Camera, ...]) -> Posterior:
    """Return what the silhouettes of `clips`, seen by `cameras` in turn, tell; `validation` says how far they err."""
    joint = np.empty((len(clips), len(known.materials), MU_BINS.count))
    for view, camera in enumerate(cameras):
        curves = Curves.through(_covered(known, camera), known)
        tuned, asked = (np.arange(view, len(each), len(cameras)) for each in (validation, clips))
        variance = curves.fitted_variance(_masks(validation, tuned), validation.material[tuned], validation.mu[tuned])
        joint[asked] = curves.posterior(_masks(clips, asked), variance).joint
    return Posterior(known.materials, MU_BINS, joint)


def _covered(runs: Runs, camera: Camera) -> Floats:
    frames, instants = frames_at(runs.instants)
    cameras = Cameras.of([camera] * len(runs))
    meshes = torch.from_numpy(runs.positions[:, frames])
    covered = splat_meshes(meshes, cameras, holder_crops(cameras, instants))
    return _coarse(covered)


def _masks(clips: Clips, chosen: Integers) -> Floats:
    """Return where there is cloth, (clips, n): brighter than half way from the floor to the bright part of the
    cloth."""
    crops = clips.crops[torch.from_numpy(chosen)]
    low, high = (torch.quantile(crops.flatten(1), q, dim=1)[:, None, None, None] for q in (0.3, 0.9))
    return _coarse(((crops - low) / (0.5 * (high - low) + 1e-3)).clamp(0.0, 1.0))


def _coarse(masks: torch.Tensor) -> Floats:
    """Return means over 4 x 4 pixels of masks (n, F, 72, 88), (n, numbers): they keep where an edge lies within one."""
    return np.asarray(torch.nn.functional.avg_pool2d(masks, 4).flatten(1).numpy(), dtype=np.float64)
