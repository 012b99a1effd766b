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
import torch
from stickslip_schemas.cameras import load_rig
from stickslip_training.cli.cloth import SHARES
from stickslip_training.cloth.crop import Cameras, cut, grey, holder_crops
from stickslip_training.cloth.evaluation import Errors, predictions, score
from stickslip_training.cloth.runs import load_runs, split_of_runs
from stickslip_training.cloth.training import RIG, Clips, FrictionModel, frames_at, load_friction


def read(path: Path, model: FrictionModel) -> tuple[Clips, list[dict[str, Any]]]:
    """Return the crops of the clips that `blender_clips.py` wrote, and what is true of each."""
    with np.load(path) as file:
        video, shown = file["video"], tuple(map(int, file["instants"]))
        about = [json.loads(str(line)) for line in file["about"]]
    frames, instants = frames_at(shown, model.instants)
    named = {camera.name: camera for camera in load_rig(RIG)}
    seen = Cameras.of([named[clip["viewpoint"]] for clip in about])
    crops = [
        cut(grey(torch.from_numpy(video[i : i + 1, frames])), holder_crops(seen[i : i + 1], instants))
        for i in range(len(video))
    ]
    return Clips(
        torch.cat(crops),
        seen.rotation[:, 2],
        np.array([model.materials.index(clip["material"]) for clip in about]),
        np.array([clip["mu"] for clip in about]),
        np.array([clip["landed_side"] for clip in about]),
        np.array([clip["run"] for clip in about]),
    ), about


def some(clips: Clips, chosen: np.ndarray[Any, Any]) -> Clips:
    """Return some of the clips."""
    mask = torch.from_numpy(chosen)
    return Clips(
        clips.crops[mask],
        clips.direction[mask],
        clips.material[chosen],
        clips.mu[chosen],
        clips.landed[chosen],
        clips.run[chosen],
    )


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
        clips, about = read(path, model)
        answers = row(path.stem, model, clips)
        records += [{"set": path.stem, **true, **answer} for true, answer in zip(about, answers, strict=True)]
        angles = [re.search(r"\d+", clip["viewpoint"]) for clip in about]
        turns = sorted({int(angle[0]) for angle in angles if angle is not None})
        for turn in turns:
            of_turn = np.array([angle is not None and int(angle[0]) == turn for angle in angles])
            row(f"{path.stem}, {turn} degrees", model, some(clips, of_turn))
        for way in ("azimuth", "elevation") if turns else ():
            of_way = np.array([way in clip["viewpoint"] for clip in about])
            if of_way.any():
                row(f"{path.stem}, {way}", model, some(clips, of_way))
    if args.records is not None:
        args.records.write_text("".join(json.dumps(record) + "\n" for record in records))


if __name__ == "__main__":
    main()
