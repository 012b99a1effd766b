"""Patches of cloth on floors that are shaken, against a rigid block: how wrong valid runs are.

    python benchmarks/shaken_floors.py [--preset certified] [--floors 120] [--draw 1]
        [--frequencies 33 60]

A floor rests, and then shakes as size (1 - cos(2 pi f t)). Frequency, size, friction and the
instant at which it begins are drawn at random, and `--draw` numbers the drawing: settings of the
solver are chosen on other drawings than those that judge them. The error of a run is the largest
of three times, over the largest way of the block. Prints a line for each run above 5 %, and a sum.
"""

import argparse
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from stickslip_sim_core import PRESETS, Scene, fabric, plane, preset_named
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Body
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.reference.oscillation import shaken_block

SHAKEN = (0.1, 0.2, 0.3)
"""Times at which the way is compared, since the floor began to shake [s]."""

STEP = 1e-5
"""Step of the integration of the block [s]."""

FRAME_RATE = 1000.0
"""Frames in a second: a time of comparison is at most half a millisecond from a frame."""

LARGEST_ERROR = 0.05
"""Error up to which a valid run is right."""


@dataclass(frozen=True)
class Floor:
    """A floor that rests, and then shakes."""

    frequency: float
    """[1/s]"""
    size: float
    """Half of its way [m]."""
    mu: float
    """Coefficient of friction."""
    rest: float
    """Time at which it begins [s]."""

    def place(self, time: float) -> float:
        """Return where the floor is at a time [m]."""
        phase = 2.0 * math.pi * self.frequency * max(time - self.rest, 0.0)
        return self.size * (1.0 - math.cos(phase))


def drawn_floors(number: int, draw: int, frequencies: Sequence[float]) -> list[Floor]:
    """Return floors whose numbers are drawn evenly, frequency and size by their logarithms.

    The frequencies are the given ones in turn, if there are any.
    """
    rng = np.random.default_rng(draw)
    frequency = np.exp(rng.uniform(np.log(12.0), np.log(70.0), number))
    if frequencies:
        frequency = np.resize(frequencies, number)
    size = np.exp(rng.uniform(np.log(0.5e-3), np.log(4.0e-3), number))
    mu = rng.uniform(0.2, 1.2, number)
    rest = rng.uniform(0.4, 0.8, number)
    rows = np.stack([frequency, size, mu, rest], axis=1)
    return [Floor(*map(float, row)) for row in rows]


def patch_on(floor: Floor, preset: str) -> Scene:
    """Return a scene of a patch of 4 cm that rests on the floor."""
    mesh = meshes.grid(0.04, 0.04, 2, 2)
    gravity = np.tile([0.0, 0.0, -GRAVITY], (len(mesh.rest), 1))

    def motion(time: float) -> tuple[Floats, Sequence[Body]]:
        return gravity, [plane(floor.mu, origin=[floor.place(time), 0.0, 0.0])]

    return Scene(
        mesh=mesh,
        fabrics=[fabric("gray-interlock")],
        preset=preset_named(preset),
        start=np.column_stack([mesh.rest, np.zeros(len(mesh.rest))]),
        motion=motion,
        frames=int((floor.rest + SHAKEN[-1]) * FRAME_RATE) + 2,
        frame_rate=FRAME_RATE,
    )


def error_of(positions: Floats, times: Floats, floor: Floor) -> float:
    """Return the largest error of the patch's place, over the largest way of the block."""
    ways = (positions - positions[0])[:, :, 0].mean(axis=1)
    moved = np.interp(floor.rest + np.array(SHAKEN), times, ways)
    block = [
        shaken_block(floor.frequency, floor.size, floor.mu, until, step=STEP) for until in SHAKEN
    ]
    return float(np.abs(moved - block).max() / np.abs(block).max())


def main() -> None:
    """Run the floors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--preset", default="certified", choices=sorted(PRESETS))
    parser.add_argument("--floors", type=int, default=120)
    parser.add_argument("--draw", type=int, default=1)
    parser.add_argument("--frequencies", type=float, nargs="+", default=(), help="[1/s]")
    options = parser.parse_args()
    valid_errors = []
    for floor in drawn_floors(options.floors, options.draw, options.frequencies):
        run = patch_on(floor, options.preset).run()
        if not run.valid:
            continue
        error = error_of(run.positions, run.times, floor)
        valid_errors.append(error)
        if error > LARGEST_ERROR:
            print(f"{error:.1%}: {floor}", flush=True)
    if not valid_errors:
        print(f"{options.preset}: none of {options.floors} valid")
        return
    print(
        f"{options.preset}: {len(valid_errors)} of {options.floors} valid, "
        f"median {statistics.median(valid_errors):.2%}, largest {max(valid_errors):.2%}, "
        f"{sum(error > LARGEST_ERROR for error in valid_errors)} above {LARGEST_ERROR:.0%}"
    )


if __name__ == "__main__":
    main()
