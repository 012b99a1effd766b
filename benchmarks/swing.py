"""Error and cost of the presets for a swinging strip, and the cost of second order at equal error.

    python benchmarks/swing.py [--repeats 9] [--cells 20]

A strip of 20 cm is let go at 17 degrees, straight and unstretched, and swings for 2 s. Its tip is
compared at 200 instants a second with that of fixed steps of 0.1 ms. The cost is that of the steps:
the median of repeated runs, which take turns.

The last line compares `fine` without second order, as it was before, with the widest step error
that is no less exact with second order.
"""

import argparse
import math
import os
import time
from collections.abc import Mapping
from dataclasses import replace
from statistics import median

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from stickslip_sim_core import PRESETS, Cloth, SolverSettings, fabric
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.reference.oscillation import chain_period

LENGTH = 0.2  # m
WIDTH = 0.02  # m
ANGLE = math.radians(17.0)  # of the start, from the vertical
DURATION = 2.0  # s
RATE = 200  # of the instants that are compared [1/s]
REFERENCE = replace(PRESETS["fine"], step_error=None, time_step=1e-4)
FIRST_ORDER = replace(PRESETS["fine"], second_order=False)
STEP_ERRORS = 1e-5 * 2.0 ** np.arange(1.0, 9.0, 0.25)  # that second order may have [m]


def swung(preset: SolverSettings, cells: int) -> tuple[Floats, float]:
    """Return the path of the tip, (instants, 3) [m], and the CPU time of the steps [s]."""
    mesh = meshes.grid(WIDTH, LENGTH, max(1, cells // 10), cells)
    down = 0.5 * LENGTH - mesh.rest[:, 1]
    start = np.column_stack([math.sin(ANGLE) * down, mesh.rest[:, 0], -math.cos(ANGLE) * down])
    top = np.flatnonzero(down < 1e-9)
    tip = np.flatnonzero(down > LENGTH - 1e-9)
    cloth = Cloth(mesh, fabric("gray-interlock"), preset, held=top)
    cloth.set_state(start)
    gravity = cloth.gravity.copy()
    path = []
    seconds = 0.0
    for instant in np.arange(1, round(DURATION * RATE) + 1) / RATE:
        begin = time.process_time()
        cloth.advance(instant, lambda _time: (gravity, start[top], ()))
        seconds += time.process_time() - begin
        path.append(cloth.positions_at(instant)[tip].mean(axis=0))
    return np.array(path), seconds


def error_of(path: Floats, reference: Floats) -> float:
    """Return the RMS distance of two paths [mm]."""
    return 1e3 * float(np.sqrt(((path - reference) ** 2).sum(axis=1).mean()))


def amplitude_of(path: Floats) -> float:
    """Return the largest horizontal displacement within the last half period [m]."""
    half = round(0.5 * chain_period(LENGTH) * RATE)
    return float(np.abs(path[-half:, 0]).max())


def equally_exact(reference: Floats, cells: int) -> SolverSettings:
    """Return the widest step error of second order that is no less exact than first order."""
    limit = error_of(swung(FIRST_ORDER, cells)[0], reference)
    for step_error in sorted(STEP_ERRORS, reverse=True):
        preset = replace(PRESETS["fine"], step_error=float(step_error))
        if error_of(swung(preset, cells)[0], reference) <= limit:
            return preset
    raise ValueError(f"no step error of second order has at most {limit:.2f} mm")


def costs_of(presets: Mapping[str, SolverSettings], cells: int, repeats: int) -> dict[str, float]:
    """Return the median CPU time of each preset [s]."""
    seconds: dict[str, list[float]] = {name: [] for name in presets}
    for _ in range(repeats):
        for name, preset in presets.items():
            seconds[name].append(swung(preset, cells)[1])
    return {name: median(values) for name, values in seconds.items()}


def main() -> None:
    """Print a row for each preset, with second order and without."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--cells", type=int, default=20, help="along the strip")
    args = parser.parse_args()
    reference, _ = swung(REFERENCE, args.cells)
    presets = {name: PRESETS[name] for name in ("fast", "certified", "fine")}
    for name in tuple(presets):
        presets[f"{name}, first order"] = replace(presets[name], second_order=False)
    equal = equally_exact(reference, args.cells)
    presets["equally exact"] = equal
    costs = costs_of(presets, args.cells, args.repeats)
    print(f"the reference swings by {1e3 * amplitude_of(reference):.1f} mm at the end")
    print("| preset | amplitude kept | RMS error of the tip [mm] | CPU time [s] |")
    print("|---|---|---|---|")
    for name, preset in presets.items():
        path, _ = swung(preset, args.cells)
        share = 100.0 * amplitude_of(path) / amplitude_of(reference)
        print(f"| {name} | {share:.1f} % | {error_of(path, reference):.2f} | {costs[name]:.3f} |")
    ratio = costs["equally exact"] / costs["fine, first order"]
    print(
        f"second order with a step error of {1e3 * (equal.step_error or 0.0):.2g} mm costs", end=" "
    )
    print(f"{ratio:.2f} of first order at equal error")


if __name__ == "__main__":
    main()
