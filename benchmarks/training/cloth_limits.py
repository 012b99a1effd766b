"""What simulations can tell of friction without learning: the oracle, which sees vertices, with cameras that are off.

    python benchmarks/training/cloth_limits.py RUNS.npz [--out limits.jsonl]

RUNS.npz is of `cloth_runs.py --pack`. In each of eight splits a quarter of each fabric's simulations is matched to what
lies between the others. Prints the mean absolute error of mu by band, over tests with mu from 0.4 to 1.4, in the
calibrated view; and by the side to which the cloth fell over tests below 0.4, where there are two branches.
"""

import argparse
import json
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
from stickslip_training.cloth.evaluation import Truth, measure, score
from stickslip_training.cloth.interpolation import Observation, oracle
from stickslip_training.cloth.posterior import Posterior, estimates
from stickslip_training.cloth.runs import Runs, load_runs, split_runs
from stickslip_training.cloth.training import training_cameras

SEEN = {
    "0.5 px a vertex": Observation(noise=0.5, registered=False),
    "camera off by 0.5 px, 0.2 %": Observation(shift=0.5, scale=0.002, registered=False),
    "the same, registered": Observation(shift=0.5, scale=0.002),
    "camera off by 1 px, 0.4 %": Observation(shift=1.0, scale=0.004, registered=False),
    "the same one, registered": Observation(shift=1.0, scale=0.004),
}
SPLITS = 8
BANDS = ((0.4, 0.8), (0.8, 1.1), (1.1, 1.4))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    started = time.process_time()
    runs, camera = load_runs(args.runs), training_cameras()[0]
    print(f"{len(runs)} simulations, {SPLITS} splits")
    for name, seen in SEEN.items():
        parts = []
        for seed in range(SPLITS):
            train, validation, test = split_runs(runs, (0.12, 0.25), seed)
            test = test[test.mu <= BANDS[-1][1]]
            parts.append((test, oracle(Runs.joined(train, validation), test, camera, seen, seed)))
        mu, material, landed = (
            np.concatenate([getattr(test, each) for test, _ in parts]) for each in ("mu", "material", "landed")
        )
        first = parts[0][1]
        posterior = Posterior(first.materials, first.bins, np.concatenate([found.joint for _, found in parts]))
        # A simulation is tested with in several splits: it is one all the same.
        same = np.unique(np.stack([material, mu]), axis=1, return_inverse=True)[1].reshape(-1)
        off = np.abs(estimates(posterior.mu, posterior.bins).median - mu)
        above = mu >= BANDS[0][0]
        sides = [measure(off[~above & (landed == side)], same[~above & (landed == side)]) for side in (-1, 1)]
        upper = Posterior(first.materials, first.bins, posterior.joint[above])
        scores = score(upper, Truth(material[above], mu[above], landed[above], same[above]))
        bands = [float(off[(mu >= low) & (mu < high)].mean()) for low, high in BANDS]
        assert scores.top_1 is not None
        told = " / ".join(f"{mae:.3f}" for mae in bands)
        print(
            f"{name}: MAE {scores.blind.mae}, by band {told}, material {scores.top_1.value:.0%}; below 0.4 "
            f"{sides[0].value:.3f} on side -1, {sides[1].value:.3f} on side +1",
            flush=True,
        )
        if args.out is not None:
            with args.out.open("a") as file:
                record = {
                    "seen": asdict(seen),
                    "runs": len(runs),
                    "bands": bands,
                    "sides": [each.value for each in sides],
                    "scores": scores.as_dict(),
                }
                file.write(json.dumps(record) + "\n")
    print(f"{time.process_time() - started:.0f} CPU s")


if __name__ == "__main__":
    main()
