"""How well a model measures friction from Blender's clips of simulations that it has not seen, set by set.

    python benchmarks/training/friction_tables.py numbers RUNS.npz [--split test]
    python benchmarks/training/friction_tables.py measure MODEL CLIPS.npz ... --records FILE.jsonl
    python benchmarks/training/friction_tables.py draw FILE.jsonl [--figure FILE.png]

`numbers` prints the numbers of the runs of a split of a packed file, for `blender_clips.py --only`. `measure` writes an
answer for each clip to the file, and draws it. `draw` needs no model and no clip. It prints a row for each file of
clips. Where viewpoints are turned it adds a row for each angle and for each viewpoint. The figure shows the first set.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from stickslip_training.cli.cloth import SHARES
from stickslip_training.cloth.clips import clips_of_file
from stickslip_training.cloth.evaluation import Errors, errors, measure
from stickslip_training.cloth.posterior import Estimates, estimates
from stickslip_training.cloth.runs import load_runs, split_of_runs
from stickslip_training.cloth.training import VIEWPOINTS, FrictionModel, load_friction

SPLITS = ("train", "validation", "test")

Record = dict[str, Any]


def answers(path: Path, model: FrictionModel) -> list[Record]:
    """Return what is true of each clip of a file, and what the model says of it."""
    clips, about = clips_of_file(path, model.materials)
    posterior, strangeness = model.look(clips)
    blind = estimates(posterior.mu, posterior.bins)
    given = estimates(posterior.given(clips.material), posterior.bins)
    return [
        {
            "set": path.stem,
            **{key: true[key] for key in ("run", "material", "mu", "landed_side", "viewpoint", "texture")},
            "median": round(float(blind.median[clip]), 4),
            "low": round(float(blind.low[clip]), 4),
            "high": round(float(blind.high[clip]), 4),
            "given_median": round(float(given.median[clip]), 4),
            "taken_for": posterior.materials[int(posterior.material[clip].argmax())],
            "strangeness": round(float(strangeness[clip]), 3),
        }
        for clip, true in enumerate(about)
    ]


def row(name: str, records: list[Record]) -> None:
    """Print a row."""
    told = {key: np.array([record[key] for record in records]) for key in records[0]}
    blind = errors(Estimates(told["median"], told["low"], told["high"]), told["mu"], told["run"])
    given = errors(Estimates(told["given_median"], told["low"], told["high"]), told["mu"], told["run"])
    right = measure((told["material"] == told["taken_for"]).astype(float), told["run"])

    def shares(part: Errors) -> str:
        return f"{part.within_01.value:.0%} / {part.within_02.value:.0%}"

    print(
        f"| {name} | {blind.clips} of {blind.simulations} | {blind.mae} | {shares(blind)} | {shares(given)} "
        f"| {right.value:.0%} | {blind.coverage.value:.0%} | {(told['strangeness'] > 1).mean():.0%} |",
        flush=True,
    )


def draw(records: list[Record]) -> None:
    """Print the table."""
    print(
        "| clips | clips of simulations | mean error | < 0.1 / < 0.2 | material given | material | in 80 % | unlike |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in dict.fromkeys(record["set"] for record in records):
        own = [record for record in records if record["set"] == name]
        row(name, own)
        turns = {view: int(view.rsplit("-", 1)[1]) for view in {r["viewpoint"] for r in own} if view not in VIEWPOINTS}
        for angle in sorted(set(turns.values())):
            row(f"{name}, {angle} degrees", [r for r in own if turns.get(r["viewpoint"]) == angle])
        for view in sorted(turns):
            row(f"{name}, {view}", [r for r in own if r["viewpoint"] == view])


def figure(records: list[Record], path: Path) -> None:
    """Draw what was estimated for each clip of the first set over what is true, and errors over the true mu."""
    import matplotlib.pyplot as plt

    own = [record for record in records if record["set"] == records[0]["set"]]
    mu, median, low, high = (np.array([record[key] for record in own]) for key in ("mu", "median", "low", "high"))
    inside = (low <= mu) & (mu <= high)
    canvas, (left, right) = plt.subplots(1, 2, figsize=(9.6, 4.4), constrained_layout=True)
    left.plot([0, 1.6], [0, 1.6], color="0.7", linewidth=1)
    for chosen, color, name in ((inside, "#2b6cb0", "holds the truth"), (~inside, "#c8102e", "does not")):
        left.vlines(mu[chosen], low[chosen], high[chosen], color=color, alpha=0.25, linewidth=1)
        left.plot(
            mu[chosen], median[chosen], ".", color=color, markersize=3, label=f"80 % set {name} ({chosen.mean():.0%})"
        )
    left.set(xlabel="true friction coefficient", ylabel="estimated: median and 80 % set", xlim=(0, 1.6), ylim=(0, 1.6))
    left.legend(frameon=False, fontsize=8)
    for name in dict.fromkeys(record["set"] for record in records):
        some = [record for record in records if record["set"] == name]
        off = np.array([abs(record["median"] - record["mu"]) for record in some])
        band = np.array([min(int(record["mu"] / 0.2), 7) for record in some])
        right.plot(0.1 + 0.2 * np.arange(8), [off[band == each].mean() for each in range(8)], "o-", label=name)
    right.set(xlabel="true friction coefficient", ylabel="mean error", xlim=(0, 1.6), ylim=(0, None))
    right.legend(frameon=False, fontsize=8)
    canvas.savefig(path, dpi=110)


def main() -> None:
    """Print the numbers of the test runs, or the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    actions = parser.add_subparsers(dest="action", required=True)
    numbered = actions.add_parser("numbers")
    numbered.add_argument("runs", type=Path)
    numbered.add_argument("--split", choices=SPLITS, default="test")
    asked = actions.add_parser("measure")
    asked.add_argument("model", type=Path)
    asked.add_argument("clips", type=Path, nargs="+")
    asked.add_argument("--records", type=Path, required=True)
    drawn = actions.add_parser("draw")
    drawn.add_argument("records", type=Path)
    drawn.add_argument("--figure", type=Path)
    args = parser.parse_args()
    if args.action == "numbers":
        print(*np.flatnonzero(split_of_runs(load_runs(args.runs), SHARES, 0) == SPLITS.index(args.split)))
        return
    if args.action == "measure":
        model = load_friction(args.model)
        told = [json.dumps(record) for path in args.clips for record in answers(path, model)]
        args.records.write_text("\n".join(told) + "\n")
    records = [json.loads(line) for line in args.records.read_text().splitlines()]
    draw(records)
    if args.action == "draw" and args.figure is not None:
        figure(records, args.figure)


if __name__ == "__main__":
    main()
