"""Drape: a round sheet on a smaller disc, as a plate that sags little."""

import numpy as np
from numpy.typing import NDArray

from stickslip_measure.contract import Floats, Sheet
from stickslip_measure.laboratory import DOWN, GRAVITY, Experiment, Laboratory, Reading, settled

DISC = 0.05  # radius of the disc [m]
SHEET = 0.1  # radius of the sheet [m]
DENSITY = 0.2  # kg/m^2
BENDING = 1e-3  # N m
STRETCHING = 300.0  # N/m
LIGHT = 0.1
"""Share of gravity: the rim sags by so little that the sheet does not stretch."""

DAMPING = 10.0  # 1/s
SETTLING = 12.0  # longest time of settling [s]
SECTORS = 1.0
"""Length of a cell along a circle in the middle, over its length along a radius."""


def profile(radii: Floats) -> Floats:
    """Return the sag of the plate at radii (N,) [m], for the load of `LIGHT`.

    w = q r^4 / (64 D) + a + b r^2 + c ln r + d r^2 ln r, with w = w' = 0 at the disc, and neither
    moment nor shear force at the rim [Timoshenko and Woinowsky-Krieger 1959, Sec. 17]; Poisson's
    ratio is 0.
    """
    load = LIGHT * GRAVITY * DENSITY / BENDING
    a = DISC
    b = SHEET
    # Rows: w(a), w'(a), w''(b), and the derivative of the Laplacian at b.
    system = [
        [1.0, a**2, np.log(a), a**2 * np.log(a)],
        [0.0, 2.0 * a, 1.0 / a, 2.0 * a * np.log(a) + a],
        [0.0, 2.0, -1.0 / b**2, 2.0 * np.log(b) + 3.0],
        [0.0, 0.0, 0.0, 4.0 / b],
    ]
    particular = [
        load * a**4 / 64.0,
        load * a**3 / 16.0,
        load * 3.0 * b**2 / 16.0,
        load * b / 2.0,
    ]
    c = np.linalg.solve(np.array(system), -np.array(particular))
    r = radii
    return np.asarray(
        load * r**4 / 64.0 + c[0] + c[1] * r**2 + c[2] * np.log(r) + c[3] * r**2 * np.log(r)
    )


def ring(cells: int) -> tuple[Floats, NDArray[np.int32], float]:
    """Return vertices (V, 2) [m], triangles and the cell of a ring, whose first two rows are held.

    The rows stand half a cell before the disc's edge and half a cell behind it.
    """
    cell = (SHEET - DISC) / (cells - 0.5)
    radii = DISC + cell * (np.arange(cells + 1) - 0.5)
    sectors = round(np.pi * (DISC + SHEET) / (SECTORS * cell))
    angles = 2.0 * np.pi * np.arange(sectors) / sectors
    rest = np.stack(
        [np.outer(radii, np.cos(angles)).ravel(), np.outer(radii, np.sin(angles)).ravel()], axis=1
    )
    row = np.repeat(np.arange(cells), sectors)
    column = np.tile(np.arange(sectors), cells)
    following = (column + 1) % sectors
    # Corners of each cell, counter-clockwise: inner, outer, outer of the next sector, inner of it.
    inner = row * sectors + column
    outer = inner + sectors
    next_inner = row * sectors + following
    next_outer = next_inner + sectors
    rising = (row + column) % 2 == 0
    up = np.stack([inner, outer, next_outer, inner, next_outer, next_inner], axis=1)
    down = np.stack([inner, outer, next_inner, outer, next_outer, next_inner], axis=1)
    triangles = np.where(rising[:, None], up, down).reshape(-1, 3)
    return rest, triangles.astype(np.int32), cell


def drape(laboratory: Laboratory, cells: int) -> Reading:
    """Measure the bending stiffness of a ring that bends along radii and around."""
    rest, triangles, cell = ring(cells)
    radius = np.linalg.norm(rest, axis=1)
    scene = Sheet(
        rest,
        np.column_stack([rest, np.zeros(len(rest))]),
        triangles,
        np.zeros(len(rest), dtype=np.int32),
        cell,
        density=DENSITY,
        stretching=STRETCHING,
        bending=laboratory.softer * BENDING,
        held=np.flatnonzero(radius < DISC + 0.75 * cell),
        gravity=(0.0, 0.0, -LIGHT * GRAVITY),
    )
    simulation = laboratory.open(scene)
    simulation.settle_gently(DAMPING)
    # The sag is far smaller than the sheet, and so is what counts as rest.
    still = settled(simulation, LIGHT * DOWN, 0.01 * SHEET, SETTLING)
    sag = -still[:, 2].reshape(cells + 1, -1).mean(axis=1)
    radii = radius.reshape(cells + 1, -1).mean(axis=1)
    exact = profile(np.maximum(radii, DISC))
    return Reading(float(exact[-1] / sag[-1]), 1.0, 1e3 * radii, -1e3 * sag, -1e3 * exact)


EXPERIMENTS = (
    Experiment(
        "drape",
        "A round sheet on a disc, slightly draped",
        "the ring plate [Timoshenko and Woinowsky-Krieger 1959]",
        "D that follows from the sag of the rim, over D",
        "",
        frozenset({"held"}),
        (4, 6, 9),
        ("radius [mm]", "height [mm]"),
        drape,
    ),
)
