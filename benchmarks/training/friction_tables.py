"""How well a model measures friction from Blender's clips of simulations that it has not seen, set by set.

    python benchmarks/training/friction_tables.py --numbers RUNS.npz
    python benchmarks/training/friction_tables.py MODEL CLIPS.npz ... [--records FILE.jsonl]

The first form prints the numbers of the test runs of a packed file, for `blender_clips.py --only`. The second prints a
row for each file of clips, and one for each angle where viewpoints are turned. The raw answers go to `--records`.
"""

import argparse
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from stickslip_training.cli.cloth import SHARES
from stickslip_training.cloth.clips import clips_of_file
from stickslip_training.cloth.evaluation import Errors, predictions, score
from stickslip_training.cloth.runs import load_runs, split_of_runs
from stickslip_training.cloth.training import Clips, FrictionModel, load_friction


def row(name: str, model: FrictionModel, clips: Clips) -> list[dict[str, Any]]:
    """Print a row, and return the answers."""
    posterior, strangeness = model.look(clips)
    scores = score(posterior, clips.truth())
    assert scores.top_1 is not None
    assert scores.given is not None

    def shares(errors: Errors) -> str:
        return f"{errors.mae} | {errors.within_01.value:.0%} / {errors.within_02.value:.0%}"

    print(
        f"| {name} | {scores.blind.clips} of {scores.blind.simulations} | {shares(scores.blind)} "
        f"| {scores.given.within_01.value:.0%} / {scores.given.within_02.value:.0%} | {scores.top_1.value:.0%} "
        f"| {scores.blind.coverage.value:.0%} | {(strangeness > 1).mean():.0%} |",
        flush=True,
    )
    return predictions(posterior, range(len(clips)))


def main() -> None:
    """Print the numbers of the test runs, or the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("files", nargs="+", type=Path, metavar="MODEL CLIPS")
    parser.add_argument("--numbers", action="store_true")
    parser.add_argument("--records", type=Path)
    args = parser.parse_args()
    if args.numbers:
        print(*np.flatnonzero(split_of_runs(load_runs(args.files[0]), SHARES, 0) == 2))
        return
    model = load_friction(args.files[0])
    print(
        "| clips | clips of simulations | mean error | < 0.1 / < 0.2 | material given | material | in 80 % | unlike |"
    )
    print("|---|---|---|---|---|---|---|---|")
    records = []
    for path in args.files[1:]:
        clips, about = clips_of_file(path, model.materials)
        answers = row(path.stem, model, clips)
        records += [{"set": path.stem, **true, **answer} for true, answer in zip(about, answers, strict=True)]
        angles = [re.search(r"\d+", clip["viewpoint"]) for clip in about]
        turns = sorted({int(angle[0]) for angle in angles if angle is not None})
        for turn in turns:
            of_turn = np.array([angle is not None and int(angle[0]) == turn for angle in angles])
            row(f"{path.stem}, {turn} degrees", model, clips[of_turn])
        for way in ("azimuth", "elevation") if turns else ():
            of_way = np.array([way in clip["viewpoint"] for clip in about])
            if of_way.any():
                row(f"{path.stem}, {way}", model, clips[of_way])
    if args.records is not None:
        args.records.write_text("".join(json.dumps(record) + "\n" for record in records))


if __name__ == "__main__":
    main()
