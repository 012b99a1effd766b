"""Capstan: a strip slides over a cylinder, because one end hangs lower than the other.

A holder whose force is measured is not needed: the acceleration shows the friction.
"""

from dataclasses import dataclass

import numpy as np
from stickslip_sim_core.cloth import meshes

from stickslip_measure.contract import Body, Floats, Sheet
from stickslip_measure.laboratory import (
    DOWN,
    GRAVITY,
    Experiment,
    Laboratory,
    NoValueError,
    Reading,
)

MU = 0.3
RADIUS = 0.05  # m
LIGHT = 0.05  # length that hangs on one side [m]
HEAVY = 0.35  # length that hangs on the other [m]
DENSITY = 0.1  # kg/m^2
STRETCHING = 1e4  # N/m: the strip is longer by 3e-5 under its weight
BENDING = 1e-9  # N m: bending changes the result by less than 1e-3
WIDTH = 2  # cells

LONGEST = 0.3  # s
FARTHEST = 0.03  # distance after which the measurement ends [m]: the light end must stay behind
BEGIN = 0.003  # distance after which it begins [m]: the strip has taken up its tension
SUBSTEPS = 50  # of the closed form, in a step


@dataclass(frozen=True)
class Hanging:
    """How a strip hangs over a cylinder. Lengths are whole numbers of cells [m]."""

    radius: float
    light: float
    heavy: float


def acceleration(friction: float, x: float, v: float, hanging: Hanging) -> float:
    """Return the acceleration of a strip that has slid by x at the speed v [m/s^2].

    With the angle phi from the light side, the tension T over the mass per length satisfies

        dT/dphi = R a + R g cos phi + mu (T - v^2 + R g sin phi),
        T(0) = (light - x) (g + a),   T(pi) = (heavy + x) (g - a).

    Without the strip's own weight on the cylinder this is Euler's exp(mu pi) [Euler 1769].
    """
    growth = np.exp(friction * np.pi)
    constant = (1.0 - 1.0 / growth) / friction
    # The integrals of exp(-mu phi) times sine and cosine.
    sine = (1.0 + 1.0 / growth) / (1.0 + friction**2)
    weight = 2.0 * friction * hanging.radius * GRAVITY * sine
    light = hanging.light - x
    heavy = hanging.heavy + x
    drive = heavy * GRAVITY - growth * (light * GRAVITY + weight - friction * v * v * constant)
    return float(drive / (heavy + growth * (light + hanging.radius * constant)))


def distances(friction: float, times: Floats, hanging: Hanging) -> Floats:
    """Return how far the strip has slid at equally spaced times (N,) [m]."""
    x = 0.0
    v = 0.0
    step = float(times[0]) / SUBSTEPS
    reached = []
    for _ in times:
        for _ in range(SUBSTEPS):
            # The midpoint rule: its error is far below that of a simulator.
            middle = acceleration(friction, x + 0.5 * step * v, v, hanging)
            x += step * (v + 0.5 * step * middle)
            v = max(v + step * middle, 0.0)
        reached.append(x)
    return np.array(reached)


def scene(laboratory: Laboratory, cells: int) -> tuple[Sheet, Hanging]:
    """Return a strip on a cylinder along y, with `cells` cells on its upper half."""
    radius = RADIUS + laboratory.description.clearance
    cell = np.pi * radius / cells
    light = round(LIGHT / cell)
    heavy = round(HEAVY / cell)
    count = light + cells + heavy
    mesh = meshes.grid(count * cell, WIDTH * cell, count, WIDTH)
    along = mesh.rest[:, 0] - mesh.rest[:, 0].min() - light * cell
    angle = np.clip(along / radius, 0.0, np.pi)
    # Beyond the half turn both ends hang straight down.
    below = np.minimum(along, 0.0) - np.maximum(along - np.pi * radius, 0.0)
    start = np.column_stack(
        [-radius * np.cos(angle), mesh.rest[:, 1], radius * np.sin(angle) + below]
    )
    strip = Sheet(
        mesh.rest,
        start,
        mesh.triangles,
        np.zeros(len(start), dtype=np.int32),
        cell,
        density=DENSITY,
        stretching=STRETCHING,
        bending=BENDING,
        bodies=(Body("cylinder", MU, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), RADIUS),),
    )
    return strip, Hanging(radius, light * cell, heavy * cell)


def capstan(laboratory: Laboratory, cells: int) -> Reading:
    """Measure the friction for which a strip slides as far as it does."""
    strip, hanging = scene(laboratory, cells)
    simulation = laboratory.open(strip)
    end = np.flatnonzero(strip.rest[:, 0] > strip.rest[:, 0].max() - 1e-9)
    frames = simulation.rest(LONGEST, DOWN)
    moved = strip.start[end, 2].mean() - frames[:, end, 2].mean(axis=1)
    times = simulation.times(len(frames))
    # Before this the strip only takes up its tension; later its light end comes onto the cylinder.
    chosen = (moved > BEGIN) & (moved < FARTHEST)
    if chosen.sum() < 2:
        raise NoValueError(f"slid {1e3 * moved[-1]:.3g} mm in {LONGEST} s")
    low = 0.01
    high = 1.0
    # The distance falls as friction grows.
    for _ in range(40):
        middle = 0.5 * (low + high)
        if distances(middle, times, hanging)[chosen].mean() > moved[chosen].mean():
            low = middle
        else:
            high = middle
    exact = distances(MU, times, hanging)
    return Reading(0.5 * (low + high) / MU, 1.0, times, 1e3 * moved, 1e3 * exact)


EXPERIMENTS = (
    Experiment(
        "capstan",
        "Capstan: a strip slides over a cylinder",
        "T2/T1 = exp(mu pi) [Euler 1769], with the strip's weight and inertia",
        "friction over mu",
        "",
        frozenset({"cylinders", "curved"}),
        (18, 36, 72),
        ("time [s]", "distance [mm]"),
        capstan,
    ),
)
