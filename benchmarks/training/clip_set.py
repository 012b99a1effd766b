"""Make a test set of clips, check it, and score a reader of friction on it.

    python benchmarks/training/clip_set.py cloth-2 [--out DIR] [--model friction.safetensors]

The set `cloth-2` has 60 simulations of ten fabrics and 600 clips over five floors, a fifth of them
in the light of a room: about an hour of CPU. It needs .venv-blender (`make setup`). DIR keeps
everything, so a second call continues where the first one stopped. Never train on these seeds.

    python benchmarks/training/clip_set.py cloth-2 --freeze SEED --about TEXT

writes the recipe and the labels of a new set into the package `stickslip_training.benchmark`.
"""

import argparse
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from clip_draws import ClipDraws, label, looks
from cloth_runs import FACTORS, points
from stickslip_sim_core import fabric_names
from stickslip_training.benchmark.clip_sets import (
    CLIP_SETS,
    ClipSet,
    digest_of,
    labels_of,
    load_clip_set,
)
from stickslip_training.cloth.model import WEIGHTS

HERE = Path(__file__).parent
BLENDER_PYTHON = os.environ.get("BLENDER_PY", ".venv-blender/bin/python")
PROCESSES = 2
"""Steps that run at once; each takes one processor."""

RECORD = Path("benchmarks/results/cloth-2.json")
"""Scores of the weights of the package, which a new set publishes."""


def main() -> None:
    """Make, check and score a set, or freeze a new one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("name")
    parser.add_argument("--out", type=Path, help="by default the name of the set")
    parser.add_argument("--model", type=Path, default=WEIGHTS)
    parser.add_argument("--freeze", type=int, metavar="SEED")
    parser.add_argument("--about", default="")
    args = parser.parse_args()
    if args.freeze is not None:
        freeze(args.name, args.freeze, args.about)
        return
    clip_set = load_clip_set(args.name)
    out = args.out or Path(args.name)
    make(clip_set, out)
    clip_set.check(out)
    print(f"{out} is {clip_set.name}: {clip_set.clips} clips", flush=True)
    score(clip_set, out, args.model)


def make(clip_set: ClipSet, out: Path) -> None:
    """Simulate and render the parts of a set that a folder does not have yet."""
    out.mkdir(parents=True, exist_ok=True)
    packed = out / "runs.npz"
    if not packed.exists():
        # A claim without its run is left over from a call that was stopped.
        for claim in (out / "runs").glob("*.claim"):
            if not claim.with_suffix(".npz").exists():
                claim.unlink()
        simulate = [sys.executable, str(HERE / "cloth_runs.py"), str(out / "runs")]
        # Two processes share the folder: each claims the next run that nobody has.
        call_all([simulate + options_of(clip_set.runs)] * PROCESSES)
        call_all([[*simulate, "--pack", str(packed)]])
    render = [BLENDER_PYTHON, str(HERE / "blender_clips.py"), str(packed)]
    commands = [
        [*render, str(path), "--segmentation", *options_of(clip_set.floors[floor])]
        for floor, path in clip_set.files(out).items()
        if not path.exists()
    ]
    call_all(commands)


def score(clip_set: ClipSet, out: Path, model: Path) -> None:
    """Score a model, and compare its mean errors with the published ones."""
    record = out / "scores.json"
    files = [str(path) for path in clip_set.files(out).values()]
    command = [sys.executable, str(HERE / "world_set.py"), str(model), str(out / "runs.npz")]
    call_all([[*command, *files, "--record", str(record)]])
    rows = {row.get("clips of"): row for row in json.loads(record.read_text())["rows"]}
    for condition, published in clip_set.published.items():
        measured = rows[condition]["mae"]
        print(f"{condition}: mean error of mu {measured:.3f}; published {published:.3f}")


def call_all(commands: list[list[str]]) -> None:
    """Run commands, some at once, each on one thread; raise CalledProcessError if one fails."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}

    def call(command: list[str]) -> None:
        subprocess.run(command, env=environment, check=True)

    with ThreadPoolExecutor(PROCESSES) as pool:
        list(pool.map(call, commands))


def options_of(settings: Any) -> list[str]:
    """Return settings as options of a command line; lists are several values."""
    options: list[str] = []
    for name, value in settings.items():
        values = value if isinstance(value, list) else [value]
        options += [f"--{name.replace('_', '-')}", *map(str, values)]
    return options


# ---- Freezing
# --------------------------------------------------------------------------------------------------


def freeze(name: str, seed: int, about: str) -> None:
    """Write the recipe and the labels of a set of a seed, with the seeds that follow from it."""
    runs = {
        "runs": 6,
        "seed": 100 * seed + 1,
        "vertices": 41,
        "preset": "certified",
        "self_friction": 0.5,
        "density": [0.9, 1.1],
        "bending": [0.9, 1.1],
        "frames": 221,
    }
    floors: dict[str, dict[str, Any]] = {
        "matt": {},
        "patterned": {"albedo": [0.3, 0.7], "grain": 0.4},
        "bright": {"albedo": [0.5, 0.85], "grain": 0.1},
        "oak": {"substrate": "light-oak"},
        "room": {"substrate": "white-table", "lighting": "room"},
    }
    for number, settings in enumerate(floors.values(), 11):
        settings |= {"seed": 100 * seed + number, "clips": 60, "textures": 2}
    labels = expected_labels(runs, floors)
    document = {
        "about": about,
        "runs": runs,
        "floors": floors,
        "clips": len(labels),
        "labels": digest_of(labels),
        "published": published_errors() if name == "cloth-2" else {},
    }
    CLIP_SETS.mkdir(exist_ok=True)
    (CLIP_SETS / f"{name}.json").write_text(json.dumps(document, indent=2) + "\n")


def published_errors() -> dict[str, float]:
    """Return the mean errors of the weights of the package: as rendered, and as a phone films."""
    rows = {row.get("clips of"): row for row in json.loads(RECORD.read_text())["rows"]}
    return {condition: rows[condition]["mae"] for condition in ("as rendered", "all")}


def expected_labels(runs: dict[str, Any], floors: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the labels of all clips of a recipe, without simulating anything."""
    about = [facts for fabric in sorted(fabric_names()) for facts in facts_of(fabric, runs)]
    labels = []
    for floor, settings in floors.items():
        draws = draws_of(settings)
        for look in looks(draws, about):
            labels += [labels_of(floor, label(look, t, draws, about)) for t in look.textures]
    plain: list[dict[str, Any]] = json.loads(json.dumps(labels))  # as the files have them
    return plain


def facts_of(fabric: str, runs: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the facts about the runs of a fabric that follow from the recipe."""
    ranges = {name: tuple(runs.get(name, (1.0, 1.0))) for name in FACTORS}
    facts = []
    for number, point in enumerate(points(fabric, runs["runs"], runs["seed"], ranges)):
        entropy = (runs["seed"], fabric_names().index(fabric), number)
        seed = int(np.random.SeedSequence(entropy).generate_state(1)[0]) % 2**31
        facts.append(
            {"material": fabric, **asdict(point), "seed": seed}
            | {name: runs[name] for name in ("vertices", "preset", "self_friction")}
        )
    return facts


def draws_of(settings: dict[str, Any]) -> ClipDraws:
    """Return the draws of a floor from the options of `blender_clips.py`."""
    finish = None
    if "albedo" in settings:
        finish = {
            "albedo": tuple(settings["albedo"]),
            "roughness": (0.4, 0.9),
            "grain": settings["grain"],
        }
    return ClipDraws(
        seed=settings["seed"],
        clips=settings["clips"],
        textures=settings["textures"],
        substrate=settings.get("substrate", "matt"),
        lighting=settings.get("lighting", "drawn"),
        finish=finish,
    )


if __name__ == "__main__":
    main()
