"""Meshes between training simulations that are neighbours in mu, for Blender to render: friction that no run has.

    python benchmarks/training/between_runs.py RUNS.npz OUT.npz [--count 300] [--seed 0]

RUNS.npz is of `cloth_runs.py --pack`. OUT.npz is for `blender_clips.py`, with the instants that a network sees. Only
runs that `stickslip-train cloth train RUNS.npz` trains on are used. Half of the meshes are mirrored.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from stickslip_training.cli.cloth import SHARES
from stickslip_training.cloth.runs import between, grid_order, load_runs, split_of_runs, write_packed
from stickslip_training.cloth.training import ClothTraining, frames_at


def main() -> None:
    """Draw, and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    runs = load_runs(args.runs)
    numbers = np.flatnonzero(split_of_runs(runs, SHARES, 0) == 0)
    known = runs[numbers]
    pairs = np.array(between(known, ClothTraining().gap))
    widths = known.mu[pairs[:, 1]] - known.mu[pairs[:, 0]]
    random = np.random.default_rng(args.seed)
    frames, instants = frames_at(known.instants)
    meshes, about = [], []
    for a, b in pairs[random.choice(len(pairs), size=args.count, p=widths / widths.sum())]:
        share, mirrored = random.random(), random.random() < 0.5
        mesh = (1 - share) * known.positions[a, frames] + share * known.positions[b, frames]
        if mirrored:
            mesh = mesh[:, :, ::-1] * (1.0, -1.0, 1.0)
        meshes.append(mesh.reshape(len(frames), -1, 3))
        mu = (1 - share) * known.mu[a] + share * known.mu[b]
        # The number of a simulation: that of the nearer one.
        told = {"run": int(numbers[a if share < 0.5 else b]), "material": known.materials[known.material[a]]}
        about.append(json.dumps({**told, "mu": round(float(mu), 6), "landed_side": int(known.landed[a])}))
    with np.load(args.runs) as file:
        order = grid_order(file["rest"]).ravel()
        triangles = np.argsort(order)[file["triangles"]]
        write_packed(args.out, np.stack(meshes), file["rest"][order], triangles, instants, about)
    print(f"{args.out}: {len(meshes)} meshes of {len(pairs)} pairs of simulations")


if __name__ == "__main__":
    main()
