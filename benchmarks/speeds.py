"""Error of the presets in time, by the speed at which a holder pulls a hanging strip.

    python benchmarks/speeds.py [--presets fast certified fine] [--speeds 0.1 0.3 1 2]

A strip of 20 cm hangs at rest. Its holder speeds up smoothly within 0.2 s and goes on. The vertices
are compared at 100 instants a second with those of fixed steps of 0.1 ms, over 0.6 s.
"""

import argparse
from dataclasses import replace

import numpy as np
from stickslip_sim_core import PRESETS, Cloth, SolverSettings, fabric
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes

LENGTH = 0.2  # m
WIDTH = 0.02  # m
SPEEDING_UP = 0.2  # s
DURATION = 0.6  # s
RATE = 100  # of the instants that are compared [1/s]
REFERENCE = replace(PRESETS["fine"], step_error=None, time_step=1e-4)

SETTLING = 1.2  # s
STEP = 0.02  # of settling [s]
DAMPING = 20.0  # of settling [1/s]: far above the rate of a swing


def way(time: float, speed: float) -> float:
    """Return how far the holder has gone [m]: its speed rises as 3 s^2 - 2 s^3."""
    s = min(time / SPEEDING_UP, 1.0)
    return speed * (SPEEDING_UP * (s**3 - 0.5 * s**4) + max(time - SPEEDING_UP, 0.0))


def pulled(speed: float, preset: SolverSettings) -> Floats:
    """Return the vertices of the strip at all instants: (instants, V, 3) [m]."""
    mesh = meshes.grid(WIDTH, LENGTH, 2, 20)
    top = np.flatnonzero(mesh.rest[:, 1] > 0.5 * LENGTH * (1.0 - 1e-9))
    flat = np.column_stack([np.zeros(len(mesh.rest)), mesh.rest])
    cloth = Cloth(mesh, fabric("gray-interlock"), preset, held=top)
    # A strip that starts unstretched would bounce, at any speed.
    cloth.set_state(flat)
    for _ in range(round(SETTLING / STEP)):
        cloth.step(STEP, held=flat[top], damping=DAMPING)
    start, gravity = cloth.positions, cloth.gravity.copy()
    cloth = Cloth(mesh, fabric("gray-interlock"), preset, held=top)
    cloth.set_state(start)
    along = np.array([1.0, 0.0, 0.0])
    path = []
    for time in np.arange(1, round(DURATION * RATE) + 1) / RATE:
        cloth.advance(time, lambda at: (gravity, start[top] + way(at, speed) * along, ()))
        path.append(cloth.positions_at(time))
    return np.array(path)


def main() -> None:
    """Print a row for each speed: RMS error, and the largest, of each preset."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--presets", nargs="+", default=["fast", "certified", "fine"])
    parser.add_argument("--speeds", nargs="+", type=float, default=[0.1, 0.3, 1.0, 2.0])
    args = parser.parse_args()
    print(f"| speed [m/s] | {' | '.join(args.presets)} [mm] |")
    print("|---|" + "---|" * len(args.presets))
    for speed in args.speeds:
        reference = pulled(speed, REFERENCE)
        cells = []
        for preset in args.presets:
            errors = 1e3 * np.linalg.norm(pulled(speed, PRESETS[preset]) - reference, axis=2)
            cells.append(f"{np.sqrt((errors**2).mean()):.2f}; {errors.max():.2f}")
        print(f"| {speed:g} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
