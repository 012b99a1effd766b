"""Length and size of the scenes of `stickslip measure`: the table of costs in docs/yardstick.md.

python benchmarks/yardstick_scenes.py

Each experiment runs on a simulator that computes nothing: its vertices drift slowly, so every scene
takes as long as it can. Times, vertices and stiffnesses are those that the experiments ask for.
"""

from pathlib import Path

import numpy as np
from stickslip_measure import experiments
from stickslip_measure.contract import CAPABILITIES, Floats, Rod, Sheet
from stickslip_measure.laboratory import GRAVITY, Experiment, Laboratory, NoValueError, SleepError
from stickslip_measure.process import Description, Program, Simulation

GUIDE = Path(__file__).parents[1] / "docs/yardstick.md"
BEGIN = "<!-- Written by benchmarks/yardstick_scenes.py; do not edit. -->"
END = "<!-- End of the table of scenes. -->"

FRAME = 0.01
"""Time of a step [s]."""

DRIFT = np.array([1e-3, 0.0, 0.0])
"""Speed of all vertices [m/s]: too fast to be at rest, and too slow to end a scene."""


class Drift(Simulation):
    """A scene whose vertices drift."""

    def __init__(self, laboratory: Laboratory, scene: Sheet | Rod) -> None:
        self.scene = scene
        self.adapter = laboratory.description
        self.frame = FRAME
        self.time = 0.0
        self.damping = None
        self.positions = scene.start if isinstance(scene, Sheet) else np.zeros((vertices(scene), 3))
        self.start = self.positions

    def advance(self, gravity: Floats) -> Floats:
        """Drift for as many steps as there are rows of gravity."""
        times = self.time + self.times(len(gravity))
        self.time = float(times[-1])
        frames = self.start + times[:, None, None] * DRIFT
        self.positions = frames[-1]
        return np.asarray(frames)


class Plan(Laboratory):
    """A laboratory that notes its scenes, and runs no process."""

    def __init__(self) -> None:
        capabilities = frozenset(CAPABILITIES)
        facts = Description("drift", "1", capabilities, {}, 0.0, 5e-4, False, "", "")
        super().__init__(Program(Path("drift.py")), facts, "default", Path("drift.log"), 1.0)
        self.scenes: list[Drift] = []

    def open(self, scene: Sheet | Rod) -> Simulation:
        """Note a scene, and return it."""
        self.scenes.append(Drift(self, scene))
        return self.scenes[-1]


def vertices(scene: Sheet | Rod) -> int:
    """Return the number of vertices of a scene."""
    return len(scene.start) if isinstance(scene, Sheet) else scene.elements + 1


def scenes_of(experiment: Experiment, cells: int) -> list[Drift]:
    """Return the scenes of an experiment at one resolution."""
    plan = Plan()
    try:
        # A patch that does not fall has no quotient of accelerations.
        with np.errstate(invalid="ignore"):
            experiment.measure(plan, cells)
    except (NoValueError, SleepError):
        # A drift is the answer of no experiment, and the scenes have run by then.
        return plan.scenes
    return plan.scenes


def softness(scene: Sheet | Rod) -> list[str]:
    """Return the stretching stiffness Y [N/m] of a sheet, and its strain under its weight."""
    if isinstance(scene, Rod):
        return ["–", "–"]
    span = float(np.ptp(scene.rest[scene.sheet == 0], axis=0).max())
    strain = scene.density * GRAVITY * span / scene.stretching
    return [f"{scene.stretching:.3g}", f"{strain:.1g}"]


def line_of(experiment: Experiment) -> str:
    """Return the line of an experiment: time, vertices, stretching stiffness, strain."""
    resolutions = [scenes_of(experiment, cells) for cells in experiment.cells]
    scenes = resolutions[0]
    length = f"{scenes[0].time:.3g}"
    if len(scenes) > 1:
        length = f"{len(scenes)} x {max(scene.time for scene in scenes):.3g}"
    counts = ", ".join(f"{vertices(each[0].scene):,}" for each in resolutions)
    return " | ".join([f"| `{experiment.name}`", length, counts, *softness(scenes[0].scene)]) + " |"


def table() -> str:
    """Return the table."""
    heads = ["experiment", "time [s]", "vertices", "`stretching` [N/m]", "strain by weight"]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    chosen = (*experiments.CHECKS.values(), *experiments.EXPERIMENTS.values())
    return "\n".join([*lines, *(line_of(experiment) for experiment in chosen)])


def completed(guide: str) -> str:
    """Return docs/yardstick.md with the table."""
    before, rest = guide.split(BEGIN)
    return f"{before}{BEGIN}\n\n{table()}\n\n{END}{rest.split(END)[1]}"


def main() -> None:
    """Write the table."""
    GUIDE.write_text(completed(GUIDE.read_text()))


if __name__ == "__main__":
    main()
