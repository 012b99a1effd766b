"""Impacts of cloth, by what presets agree in: impulse, largest force, time to rest, energy lost.

    python benchmarks/impacts.py [--presets fast certified fine] [--starts 20]

Single positions are not compared. After an impact cloth snaps and folds to one side or the other by
any small difference, and runs with steps of 0.1 ms differ by 6 to 15 mm. Each number is therefore
the mean over several starts, and has the standard error of that mean. Starts differ by a turn about
the vertical, by where the napkin hits the ball, and by the lean of the strip.
"""

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from stickslip_sim_core import PRESETS, Cloth, SelfContact, SolverSettings, fabric, plane, sphere
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Body
from stickslip_sim_core.cloth.solver import GRAVITY

DURATION = 1.5  # s
WINDOW = 0.01  # in which a force is the mean [s]: shorter ones show the steps
STILL = 1e-3  # kinetic energy at rest, over the energy of the fall
MU = 0.3
ASIDE = 0.01  # of the ball from below the middle of the napkin, for each radian of its turn [m]


@dataclass(frozen=True)
class Impact:
    """A fall onto bodies."""

    mesh: meshes.Mesh
    start: Floats
    """(V, 3) [m]"""
    bodies: list[Body]
    height: float
    """Of the fall [m]."""


def napkin(turn: float) -> Impact:
    """A square of 20 cm falls flat from 20 cm above a ball, up to 1 cm beside its middle."""
    mesh = meshes.grid(0.2, 0.2, 14, 14)
    c, s = math.cos(turn), math.sin(turn)
    flat = mesh.rest @ np.array([[c, s], [-s, c]])
    start = np.column_stack([flat, np.full(len(flat), 0.3)])
    # A napkin that falls on the middle would do the same in each start, but for rounding.
    beside = ASIDE * turn
    return Impact(mesh, start, [plane(MU), sphere(MU, 0.05, origin=[beside, 0.0, 0.05])], 0.2)


def edge_first(turn: float) -> Impact:
    """An upright strip falls on its edge from 10 cm, leaning by 2 degrees and the turn."""
    mesh = meshes.grid(0.05, 0.15, 4, 12)
    lean = math.radians(2.0) + 0.2 * turn
    up = mesh.rest[:, 1] - mesh.rest[:, 1].min()
    start = np.column_stack([mesh.rest[:, 0], math.sin(lean) * up, 0.1 + math.cos(lean) * up])
    return Impact(mesh, start, [plane(MU)], 0.1)


IMPACTS: dict[str, Callable[[float], Impact]] = {"napkin": napkin, "edge first": edge_first}


def measured(impact: Impact, preset: SolverSettings) -> Floats:
    """Return what presets are compared by: (4,).

    Impulse over weight and time, largest force over weight, time to rest [s], and energy lost over
    that of the fall.
    """
    cloth = Cloth(impact.mesh, fabric("gray-interlock"), preset, self_contact=SelfContact(MU, 5e-4))
    cloth.set_state(impact.start, bodies=impact.bodies)
    mass = cloth.masses
    weight = float(mass.sum()) * GRAVITY
    gravity, nothing = cloth.gravity.copy(), np.empty((0, 3))
    times, impulses, moving = [0.0], [0.0], [0.0]
    while cloth.time < DURATION:
        cloth.advance(
            math.nextafter(cloth.time, np.inf), lambda _time: (gravity, nothing, impact.bodies)
        )
        times.append(cloth.time)
        impulses.append(float(mass @ cloth.velocities[:, 2]) + weight * cloth.time)
        moving.append(0.5 * float(mass @ (cloth.velocities**2).sum(axis=1)))
    instants = np.arange(0.0, DURATION, WINDOW)
    forces = np.diff(np.interp(instants, times, impulses)) / WINDOW
    fall = weight * impact.height
    late = np.flatnonzero(np.array(moving) > STILL * fall)
    lifted = GRAVITY * float(mass @ (impact.start[:, 2] - cloth.positions[:, 2]))
    membrane, bending, _ = cloth._solver.energies(cloth.positions)
    lost = lifted - membrane - bending - moving[-1]
    rest = times[min(late[-1] + 1, len(times) - 1)]
    return np.array([impulses[-1] / (weight * times[-1]), forces.max() / weight, rest, lost / fall])


def main() -> None:
    """Print a row for each impact and preset."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--presets", nargs="+", default=["fast", "certified", "fine"])
    parser.add_argument("--starts", type=int, default=20)
    args = parser.parse_args()
    print("| impact | preset | impulse | largest force | time to rest [s] | energy lost |")
    print("|---|---|---|---|---|---|")
    for name, impact in IMPACTS.items():
        for preset in args.presets:
            turns = 0.1 + 0.05 * np.arange(args.starts)
            runs = np.array([measured(impact(turn), PRESETS[preset]) for turn in turns])
            means, errors = runs.mean(axis=0), runs.std(axis=0) / math.sqrt(len(runs))
            cells = [f"{m:.3f} +- {e:.3f}" for m, e in zip(means, errors, strict=True)]
            print(f"| {name} | {preset} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
