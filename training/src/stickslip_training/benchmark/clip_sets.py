"""Test sets of clips that scripts of the repository make.

A set has simulations, and clips of them over several floors.

Such a set has no dataset of the service: its fabrics, floors and lights vary more than the axes of
a spec. A set is a recipe, and the labels of its clips. They follow from the recipe to the last bit,
so another set, or one with other simulations, is noticed on any machine.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stickslip_schemas.base import canonical_json, sha256

CLIP_SETS = Path(__file__).parent / "sets" / "clips"

LABELS = (
    "run",
    "viewpoint",
    "texture",
    "substrate",
    "finish",
    "material",
    "mu",
    "factors",
    "seed",
    "vertices",
    "preset",
    "self_friction",
)
"""Labels of a clip that follow from the recipe."""


@dataclass(frozen=True)
class ClipSet:
    """A test set of clips."""

    name: str
    about: str
    runs: Mapping[str, Any]
    """Options of `benchmarks/training/cloth_runs.py`."""
    floors: Mapping[str, Mapping[str, Any]]
    """Settings of the clips of each floor: `ClipDraws` of `benchmarks/training/clip_draws.py`."""
    clips: int
    labels: str
    """SHA-256 of the labels of all clips, floor by floor."""
    published: Mapping[str, float]
    """Mean errors of the weights of the package, by condition."""

    def files(self, folder: Path) -> dict[str, Path]:
        """Return the file of clips of each floor in a folder."""
        return {floor: folder / f"{floor}.npz" for floor in self.floors}

    def check(self, folder: Path) -> None:
        """Raise ValueError if the files of a folder are not this set."""
        labels: list[dict[str, Any]] = []
        for floor, path in self.files(folder).items():
            if not path.exists():
                raise ValueError(
                    f"{folder} must hold {path.name} to be the test set {self.name}, and does not. "
                    f"python benchmarks/training/clip_set.py {self.name} makes the set"
                )
            with np.load(path) as file:
                clips = [json.loads(str(line)) for line in file["about"]]
            labels += [labels_of(floor, clip) for clip in clips]
        digest = digest_of(labels)
        if digest != self.labels:
            raise ValueError(
                f"{folder} must be the test set {self.name}, and is not: the labels of its "
                f"{len(labels)} clips have SHA-256 {digest}, and those of the set {self.labels}"
            )


def clip_set_names() -> tuple[str, ...]:
    """Return the names of all test sets of clips, in alphabetical order."""
    return tuple(sorted(file.stem for file in CLIP_SETS.glob("*.json")))


def load_clip_set(name: str) -> ClipSet:
    """Return a test set of clips; raise ValueError if there is none of this name."""
    if name not in clip_set_names():
        names = ", ".join(clip_set_names())
        raise ValueError(f"the test set of clips must be one of {names}, and is {name}")
    document = json.loads((CLIP_SETS / f"{name}.json").read_text(encoding="utf-8"))
    return ClipSet(name=name, **document)


def labels_of(floor: str, clip: Mapping[str, Any]) -> dict[str, Any]:
    """Return the labels of a clip that follow from the recipe."""
    return {"floor": floor} | {name: clip[name] for name in LABELS}


def digest_of(labels: list[dict[str, Any]]) -> str:
    """Return the SHA-256 of the labels of clips."""
    return sha256(canonical_json(labels).encode())
