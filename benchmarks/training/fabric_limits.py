"""What exact meshes tell of a fabric's numbers when its material is known: regression from vertices, leave one out.

    python benchmarks/training/fabric_limits.py RUNS.npz

RUNS.npz is of `cloth_runs.py --density LOW HIGH --bending LOW HIGH`, packed. Each simulation with mu of at least 0.3
(below that there are two branches) is estimated from all others by a Gaussian process over the principal components of
the vertices at the six instants that a network sees. Its two numbers, a length and a noise, are those with the smallest
errors, so the errors are a little too small. A guess that knows only the material is judged in the same way.
"""

import argparse
import itertools
from pathlib import Path

import numpy as np
from stickslip_training.arrays import Floats
from stickslip_training.cloth.evaluation import Measure, measure
from stickslip_training.cloth.fabric import FABRIC
from stickslip_training.cloth.runs import Runs, load_runs
from stickslip_training.cloth.training import frames_at

COMPONENTS = 8
LOWEST = 0.3
"""Of mu."""


def scores_of_meshes(runs: Runs, noise: float) -> Floats:
    """Return principal components of the vertices, seen with white noise [m], (runs, COMPONENTS), deviation 1."""
    meshes = runs.positions[:, frames_at(runs.instants)[0]].reshape(len(runs), -1).astype(np.float64)
    meshes += noise * np.random.default_rng(0).standard_normal(meshes.shape)
    u, s, _ = np.linalg.svd(meshes - meshes.mean(axis=0), full_matrices=False)
    return np.asarray(u[:, :COMPONENTS] * s[:COMPONENTS] / s[0] * np.sqrt(len(runs)))


def left_out(features: Floats, centered: Floats, length: float, noise: float) -> Floats:
    """Return the error of each run where a Gaussian process learns from the others [Rasmussen and Williams, 5.4.2]."""
    squares = np.square(features[:, None] - features).sum(axis=2)
    inverse = np.linalg.inv(np.exp(-0.5 * squares / length**2) + noise**2 * np.eye(len(features)))
    return np.asarray((inverse @ centered) / np.diag(inverse))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--noise", type=float, default=0.0, help="white noise on every coordinate [m]")
    args = parser.parse_args()
    runs = load_runs(args.runs)
    runs = runs[np.flatnonzero(runs.mu >= LOWEST)]
    number = np.arange(len(runs))
    one_hot = 3.0 * np.eye(len(runs.materials))[runs.material]
    features = np.concatenate([scores_of_meshes(runs, args.noise), one_hot], axis=1)
    print(f"{len(runs)} simulations with mu of at least {LOWEST}")
    print("| | from the meshes | knowing only the material | share of the spread that is told |")
    print("|---|---|---|---|")
    for place, quantity in enumerate((*FABRIC, None)):
        truth = runs.mu if quantity is None else np.log(10.0) * runs.fabric[:, place]
        means, apart = np.empty(len(runs)), np.empty(len(runs))
        for code in range(len(runs.materials)):
            own = np.flatnonzero(runs.material == code)
            means[own] = truth[own].mean()
            apart[own] = (truth[own] - means[own]) * len(own) / (len(own) - 1)  # from the mean of the others
        tried = itertools.product((0.5, 1.0, 2.0, 4.0, 8.0), (0.003, 0.01, 0.03, 0.1, 0.3, 1.0))
        found = min((left_out(features, truth - means, *each) for each in tried), key=lambda e: np.square(e).sum())
        told = 1.0 - np.square(found).sum() / np.square(apart).sum()
        shown: list[Measure] = [measure(np.abs(each), number) for each in (found, apart)]
        print(f"| {'mu' if quantity is None else quantity.name} | {shown[0]} | {shown[1]} | {told:.0%} |")


if __name__ == "__main__":
    main()
