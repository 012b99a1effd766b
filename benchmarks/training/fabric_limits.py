"""What meshes, and pictures, tell of a fabric's numbers when its material is known: regressions, leave one out.

    python benchmarks/training/fabric_limits.py RUNS.npz [--noise METRES] [--renders 6]

RUNS.npz is of `cloth_runs.py --density LOW HIGH --bending LOW HIGH`, packed. Each simulation with mu of at least 0.3
(below that there are two branches) is estimated from all others by a Gaussian process. It sees the principal components
of the vertices at six instants, or those of what the network of the package makes of pictures that are rendered from
them: its last features, which were learned for friction and material. The two numbers of a process, a length and a
noise, are those with the smallest errors, so the errors are a little too small. A guess that knows only the material is
judged in the same way.
"""

import argparse
import itertools
from pathlib import Path

import numpy as np
import torch
from stickslip_training.arrays import Floats, Integers
from stickslip_training.cloth.evaluation import measure
from stickslip_training.cloth.fabric import FABRIC
from stickslip_training.cloth.runs import Runs, load_runs
from stickslip_training.cloth.training import features, frames_at, load_friction, render_clips

COMPONENTS = 12
LOWEST = 0.3
"""Of mu."""


def components(values: Floats) -> Floats:
    """Return principal components of values (samples, n), (samples, COMPONENTS); the first has deviation 1."""
    u, s, _ = np.linalg.svd(values - values.mean(axis=0), full_matrices=False)
    return np.asarray(u[:, :COMPONENTS] * s[:COMPONENTS] / s[0] * np.sqrt(len(values)))


def left_out(known: Floats, centered: Floats, run: Integers, length: float, noise: float) -> Floats:
    """Return the error of each sample where a process learns from other runs [Rasmussen and Williams, 5.4.2]."""
    squares = np.square(known[:, None] - known).sum(axis=2)
    inverse = np.linalg.inv(np.exp(-0.5 * squares / length**2) + noise**2 * np.eye(len(known)))
    solved, errors = inverse @ centered, np.empty(len(known))
    for each in np.unique(run):
        own = np.flatnonzero(run == each)
        errors[own] = np.linalg.solve(inverse[np.ix_(own, own)], solved[own])
    return errors


def tell(title: str, runs: Runs, seen: Floats, run: Integers) -> None:
    """Print the table of what is seen, (samples, n), of the runs `run` (samples,) tell."""
    print(f"\n{title}: {len(seen)} of {len(runs)} simulations with mu of at least {LOWEST}\n")
    print("| | error | knowing only the material | share of the spread that is told |")
    print("|---|---|---|---|")
    one_hot = 3.0 * np.eye(len(runs.materials))[runs.material[run]]
    known = np.concatenate([seen, one_hot], axis=1)
    for place, quantity in enumerate((*FABRIC, None)):
        truth = runs.mu if quantity is None else np.log(10.0) * runs.fabric[:, place]
        means, apart = np.empty(len(runs)), np.empty(len(runs))
        for code in range(len(runs.materials)):
            own = np.flatnonzero(runs.material == code)
            means[own] = truth[own].mean()
            apart[own] = (truth[own] - means[own]) * len(own) / (len(own) - 1)  # from the mean of the others
        tried = itertools.product((0.5, 1.0, 2.0, 4.0, 8.0), (0.003, 0.01, 0.03, 0.1, 0.3, 1.0))
        found = min((left_out(known, (truth - means)[run], run, *each) for each in tried), key=lambda e: (e**2).sum())
        told = 1.0 - np.square(found).sum() / np.square(apart[run]).sum()
        shown = [measure(np.abs(each), run) for each in (found, apart[run])]
        print(f"| {'mu' if quantity is None else quantity.name} | {shown[0]} | {shown[1]} | {told:.0%} |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--noise", type=float, default=0.0, help="white noise on every coordinate of vertices [m]")
    parser.add_argument("--renders", type=int, default=6, help="clips of each simulation, with looks of their own")
    args = parser.parse_args()
    torch.set_num_threads(1)
    runs = load_runs(args.runs)
    runs = runs[np.flatnonzero(runs.mu >= LOWEST)]
    meshes = runs.positions[:, frames_at(runs.instants)[0]].reshape(len(runs), -1).astype(np.float64)
    meshes += args.noise * np.random.default_rng(0).standard_normal(meshes.shape)
    tell("Meshes", runs, components(meshes), np.arange(len(runs)))
    clips = render_clips(runs, args.renders, 0)
    seen = np.asarray(features(load_friction().nets[0], clips), dtype=np.float64)
    tell("Pictures", runs, components(seen), clips.run)


if __name__ == "__main__":
    main()
