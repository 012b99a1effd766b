"""Read friction off silhouettes with a Gaussian process: the baseline that a network has to beat.

    python benchmarks/training/gaussian_process.py TRAIN.npz CLIPS.npz ... [--seed 0]

TRAIN.npz is a packed file of `cloth_runs.py`; CLIPS.npz are of `blender_clips.py`, of other
simulations. Training clips are rendered in torch in drawn worlds. The mask network of the package
finds the cloth in all clips. The process sees 40 principal components of the six silhouettes at 4 x
4 pixels, and the direction of view.

    k(x, y) = a^2 exp(-|x - y|^2 / 2 l^2) + n^2 [x = y]

The length l and the ratio n / a have the largest marginal likelihood [Rasmussen and Williams 2006,
Eq. 2.30].
"""

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from scipy.stats import norm
from stickslip_training.arrays import Array, Floats
from stickslip_training.cloth.clips import Clips, clips_of_file, render_clips
from stickslip_training.cloth.evaluation import errors
from stickslip_training.cloth.model import FrictionModel, load_friction, silhouettes
from stickslip_training.cloth.posterior import MU_BINS, SHARE, Estimates
from stickslip_training.cloth.runs import load_runs

COMPONENTS = 40
RENDERS = 6
"""Pictures of each simulation that is trained on."""


@dataclass(frozen=True, eq=False)
class Process:
    """A Gaussian process that is conditioned on known values."""

    known: Array
    """(clips, n)"""
    mean: float
    length: float
    noise: float
    """Ratio of the deviations of noise and signal [1]."""
    amplitude: float
    factor: tuple[Array, bool]
    weights: Array

    @staticmethod
    def of(known: Array, values: Floats) -> "Process":
        """Choose length and noise, and condition on `values` (clips,) at `known` (clips, n)."""
        mean = float(values.mean())
        squared = cdist(known, known, "sqeuclidean")
        centred = values - mean

        def solved(log_length: float, log_noise: float) -> tuple[tuple[Array, bool], Array, float]:
            kernel = np.exp(-0.5 * squared / np.exp(2 * log_length)) + np.exp(
                2 * log_noise
            ) * np.eye(len(known))
            factor = cho_factor(kernel, lower=True)
            weights = cho_solve(factor, centred)
            return factor, weights, float(centred @ weights) / len(known)

        def loss(logs: Array) -> float:
            factor, _, variance = solved(*logs)
            return float(0.5 * len(known) * np.log(variance) + np.log(np.diag(factor[0])).sum())

        first = np.array([0.5 * np.log(np.median(squared)), np.log(0.1)])
        best = minimize(loss, first, method="Nelder-Mead", options={"maxfev": 60}).x
        factor, weights, variance = solved(*best)
        return Process(
            known,
            mean,
            float(np.exp(best[0])),
            float(np.exp(best[1])),
            variance**0.5,
            factor,
            weights,
        )

    def predict(self, features: Array) -> Estimates:
        """Return mu at `seen` (clips, n), and the central interval of the probability `SHARE`.

        All are within the known range of mu.
        """
        kernel = np.exp(-0.5 * cdist(features, self.known, "sqeuclidean") / self.length**2)
        left = 1 + self.noise**2 - np.einsum("ij,ji->i", kernel, cho_solve(self.factor, kernel.T))
        half = norm.ppf(0.5 + SHARE / 2) * self.amplitude * np.sqrt(np.maximum(left, 0.0))
        median = self.mean + kernel @ self.weights
        return Estimates(
            *(np.clip(part, 0.0, MU_BINS.high) for part in (median, median - half, median + half))
        )


@dataclass(frozen=True, eq=False)
class Reader:
    """Principal components of silhouettes, and the process that reads them."""

    model: FrictionModel
    mean: Array
    components: Array
    process: Process

    @staticmethod
    def of(model: FrictionModel, clips: Clips) -> "Reader":
        pixels = silhouettes(model.net, clips).reshape(len(clips), -1)
        mean = pixels.mean(axis=0)
        components = np.linalg.svd(pixels - mean, full_matrices=False)[2][:COMPONENTS]
        process = Process.of(
            np.hstack([(pixels - mean) @ components.T, clips.direction.numpy()]), clips.mu
        )
        return Reader(model, mean, components, process)

    def read(self, clips: Clips) -> Estimates:
        pixels = silhouettes(self.model.net, clips).reshape(len(clips), -1)
        return self.process.predict(
            np.hstack([(pixels - self.mean) @ self.components.T, clips.direction.numpy()])
        )


def main() -> None:
    """Print the errors on the test split of the packed file, and on each file of clips."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    started = time.process_time()
    model = load_friction()
    train = load_runs(args.runs).named(model.materials)
    reader = Reader.of(model, render_clips(train, RENDERS, args.seed, with_surroundings=True))
    fitted = reader.process
    print(
        f"{time.process_time() - started:.0f} CPU s, length {fitted.length:.3g}, noise "
        f"{fitted.noise:.3g}"
    )
    clips_by_name = {path.stem: clips_of_file(path, model.materials)[0] for path in args.clips}
    clips_by_name["all files"] = Clips.joined(list(clips_by_name.values()))
    if set(clips_by_name["all files"].mu.tolist()) & set(train.mu.tolist()):
        raise ValueError(
            f"{', '.join(map(str, args.clips))} must show no simulation of {args.runs}"
        )
    for name, clips in clips_by_name.items():
        scores = errors(reader.read(clips), clips.mu, clips.run)
        parts = {
            key: round(getattr(scores, key).value, 3)
            for key in ("mae", "within_01", "within_02", "coverage")
        }
        print(
            json.dumps(
                {
                    "clips of": name,
                    "clips": scores.clips,
                    "simulations": scores.simulations,
                    **parts,
                }
            ),
            flush=True,
        )


if __name__ == "__main__":
    main()
