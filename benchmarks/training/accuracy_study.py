"""What a simulator's accuracy does to measured friction [thesis, 4.5.2, Table 4.2]: presets, and meshes.

    python benchmarks/training/accuracy_study.py TEST.npz TRAIN.npz ... [--steps 900] [--records FILE.jsonl]

All files are of `cloth_runs.py --frames 62 --pack`: the drop and the first leg, of which two instants are seen. The
friction of the runs in TEST is measured by what is known from each TRAIN in turn: by the oracle, which sees vertices
with a noise of 0.05 px, and by a network that is trained on pictures of TRAIN. An error with a sign tells what the
simulator does; its size, what there is to learn from. Intervals are over simulations of TEST.
"""

import argparse
import json
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from stickslip_training.cloth.evaluation import measure, score
from stickslip_training.cloth.interpolation import Observation, oracle
from stickslip_training.cloth.posterior import Bins, Posterior, estimates
from stickslip_training.cloth.runs import Runs, load_runs, split_runs
from stickslip_training.cloth.training import ClothTraining, render_clips, train_friction, training_cameras

INSTANTS = (50, 60)
"""Of 300: on the first leg."""

NOISE = 0.05
"""Of a vertex [px]: little, for the registration's noise would hide what the simulator does."""

BINS = Bins(0.0, 1.6, 1600)
"""Of the oracle: what a simulator does to friction is less than a bin of the networks."""

VALIDATION = 0.125
"""Share of the runs of TRAIN that choose a network's weights and temperature."""

LOWEST = 0.3
"""Below it there are two branches, and what tells mu is which of them a cloth is on."""


def coarse(runs: Runs, side: int) -> Runs:
    """Return runs with the vertices of a coarser mesh."""
    step, left = divmod(runs.side - 1, side - 1)
    if left:
        raise ValueError(f"a mesh of {runs.side} vertices a side must have all of one of {side}: it has not")
    return replace(runs, positions=runs.positions[:, :, ::step, ::step])


def told(test_name: str, name: str, way: str, posterior: Posterior, test: Runs, renders: int) -> dict[str, object]:
    """Print and return the errors of an answer for runs, each seen `renders` times."""
    mu, run = np.repeat(test.mu, renders), np.repeat(np.arange(len(test)), renders)
    found = estimates(posterior.mu, posterior.bins)
    off = measure(np.abs(found.median - mu), run)
    signed = measure(found.median - mu, run)
    inside = measure(((found.low <= mu) & (mu <= found.high)).astype(float), run)
    right = measure((posterior.material.argmax(axis=1) == np.repeat(test.material, renders)).astype(float), run)
    print(f"| {name} | {way} | {off} | {signed} | {inside.value:.0%} | {right.value:.0%} |", flush=True)
    numbers = {"error": off, "signed": signed, "in_80": inside, "material": right}
    return {"test": test_name, "train": name, "way": way, **{key: asdict(value) for key, value in numbers.items()}}


def main() -> None:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("test", type=Path)
    parser.add_argument("train", type=Path, nargs="+")
    parser.add_argument("--steps", type=int, default=900, help="of the networks; 0 trains none")
    parser.add_argument("--records", type=Path)
    args = parser.parse_args()
    test = load_runs(args.test)
    camera = training_cameras()[0]
    started = time.process_time()
    records = []
    print(f"Tested on {args.test.stem}.")
    print("| learned from | by | mean error of mu | with sign | in 80 % | material |")
    print("|---|---|---|---|---|---|")
    for path in args.train:
        known = load_runs(path)
        # Nothing is known beyond the least and the largest mu of a fabric.
        ends = [
            (known.mu[known.material == code].min(), known.mu[known.material == code].max())
            for code in range(len(known.materials))
        ]
        low, high = np.array(ends)[test.material].T
        asked = test[(test.mu >= np.maximum(low, LOWEST)) & (test.mu <= high)]
        side = min(known.side, asked.side)
        seen = oracle(coarse(known, side), coarse(asked, side), camera, Observation(noise=NOISE), 0, INSTANTS, BINS)
        name = f"{path.stem} ({len(known)} runs)"
        records.append(told(args.test.stem, name, "oracle", seen, asked, 1))
        if args.steps:
            settings = ClothTraining(steps=args.steps, instants=INSTANTS)
            learned, validation, _ = split_runs(known, (VALIDATION, 0.0), 0)
            model = train_friction(learned, validation, settings)
            clips = render_clips(asked, 6, 99, wanted=INSTANTS)
            posterior = model.estimate(clips)
            records.append(told(args.test.stem, name, "network", posterior, asked, 6))
            records[-1]["scores"] = score(posterior, clips.truth()).as_dict()
    print(f"{time.process_time() - started:.0f} CPU s")
    if args.records is not None:
        args.records.write_text("".join(json.dumps(record) + "\n" for record in records))


if __name__ == "__main__":
    main()
