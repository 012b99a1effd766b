"""What simulations can tell of friction without learning: the oracle, which sees vertices, with cameras that are off.

    python benchmarks/training/cloth_limits.py RUNS.npz [--views 1] [--out limits.jsonl]

RUNS.npz is of `cloth_runs.py --pack`. Test simulations, a quarter of each fabric, are matched to what lies between the
others. Prints the mean absolute error of mu by band, over tests with mu from 0.4 to 1.4, in the calibrated view.
"""

import argparse
import json
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
from stickslip_training.cloth.evaluation import Truth, score
from stickslip_training.cloth.interpolation import Observation, oracle
from stickslip_training.cloth.runs import Runs, load_runs, split_runs
from stickslip_training.cloth.training import training_cameras

SEEN = {
    "0.5 px a vertex": Observation(noise=0.5, registered=False),
    "camera off by 0.5 px, 0.2 %": Observation(shift=0.5, scale=0.002, registered=False),
    "the same, registered": Observation(shift=0.5, scale=0.002),
    "camera off by 1 px, 0.4 %": Observation(shift=1.0, scale=0.004, registered=False),
    "the same one, registered": Observation(shift=1.0, scale=0.004),
}
BANDS = ((0.4, 0.8), (0.8, 1.1), (1.1, 1.4))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    started = time.process_time()
    train, validation, test = split_runs(load_runs(args.runs), (0.12, 0.25), 0)
    known = Runs.joined(train, validation)
    test = test[(test.mu >= BANDS[0][0]) & (test.mu <= BANDS[-1][1])]
    camera = training_cameras()[0]
    truth = Truth(test.material, test.mu, test.landed, np.arange(len(test)))
    print(f"{len(known)} known simulations, {len(test)} to test with")
    for name, seen in SEEN.items():
        posterior = oracle(known, test, camera, seen, 0)
        scores = score(posterior, truth)
        bands = []
        for low, high in BANDS:
            chosen = (test.mu >= low) & (test.mu < high)
            part = Truth(*(np.asarray(getattr(truth, each))[chosen] for each in ("material", "mu", "landed", "run")))
            found = type(posterior)(posterior.materials, posterior.bins, posterior.joint[chosen])
            bands.append(score(found, part).blind.mae.value if chosen.any() else None)
        assert scores.top_1 is not None
        told = " / ".join("-" if mae is None else f"{mae:.3f}" for mae in bands)
        print(f"{name}: MAE {scores.blind.mae}, by band {told}, material {scores.top_1.value:.0%}", flush=True)
        if args.out is not None:
            with args.out.open("a") as file:
                record = {"seen": asdict(seen), "known": len(known), "bands": bands, "scores": scores.as_dict()}
                file.write(json.dumps(record) + "\n")
    print(f"{time.process_time() - started:.0f} CPU s")


if __name__ == "__main__":
    main()
