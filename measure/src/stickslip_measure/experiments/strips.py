"""Strips that bend: a cantilever, and a strip on edge that buckles sideways.

A strip is clamped by two rows of vertices, half a cell before the clamp and half a cell behind it.
So it is level at the clamp itself, to second order in the cell.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from stickslip_sim_core.cloth import meshes

from stickslip_measure.contract import Floats, Sheet
from stickslip_measure.laboratory import (
    DOWN,
    GRAVITY,
    Experiment,
    Laboratory,
    NoValueError,
    Reading,
    settled,
)

LENGTH = 0.1  # m
DENSITY = 0.2  # kg/m^2
WEIGHT = DENSITY * GRAVITY * LENGTH  # per width [N/m]
DAMPING = 10.0  # 1/s

ACROSS = 4
"""Cells across a cantilever, from three cells along on: the width hardly matters."""

GAMMA = 10.0
"""Weight rho g L^3 / D of the cantilever."""

WEIGHTS = (1.0, 200.0)
"""Range of the weights that a measured sag can stand for."""

LIGHT = 0.05
"""Share of gravity at which the clamp is located: the sag is then small, and its shape known."""

STRETCHING = 3e3
"""Stretching stiffness over the weight of the cantilever."""

SETTLING = 12.0  # longest time of settling [s]

ASPECT = 0.2
"""Width over length of the strip on edge."""

BUCKLING = 20.641637
"""Weight rho g L^3 / D at which the strip on edge buckles, by finite elements of a plate, to 5e-5.

`stickslip_sim_core.reference.master_curves.lateral_buckling(0.2, 0.0)`, which a test compares.
"""

POINTS = 49
"""Chebyshev points along the closed form of the cantilever."""

RIGIDITY = 1e-4  # of the strip on edge [N m]
IN_PLANE = 3e4
"""Its stretching stiffness over its weight: it sags by 1e-3 of its length."""

SHARES = (0.5, 0.7, 0.8, 0.9)
"""Weights over the buckling weight at which the sideways deflection is measured."""

SIDEWAYS = 1e-3
"""Sideways gravity over gravity."""


@dataclass(frozen=True)
class Strip:
    """A scene of a strip along x, and its rows."""

    scene: Sheet
    along: Floats
    """Distance of each vertex from the clamp: (V,) [m]."""

    tip: NDArray[np.int64]
    """Vertices of the free end."""


def strip(
    cells: int, across: int, stretching: float, bending: float, *, upright: bool = False
) -> Strip:
    """Return a strip with its width along y, or along z if it stands upright."""
    cell = LENGTH / (cells - 0.5)
    mesh = meshes.grid(cells * cell, across * cell, cells, across)
    along = mesh.rest[:, 0] - mesh.rest[:, 0].min() - 0.5 * cell
    flat = np.zeros(len(along))
    columns = (along, flat, mesh.rest[:, 1]) if upright else (along, mesh.rest[:, 1], flat)
    scene = Sheet(
        mesh.rest,
        np.column_stack(columns),
        mesh.triangles,
        np.zeros(len(along), dtype=np.int32),
        cell,
        density=DENSITY,
        stretching=stretching,
        bending=bending,
        held=np.flatnonzero(along < 0.75 * cell),
    )
    return Strip(scene, along, np.flatnonzero(along > LENGTH - 0.25 * cell))


def clamp_offset(clamped: Strip, positions: Floats) -> float:
    """Return where a slightly bent strip begins to bend, behind the clamp, over a cell.

    A beam that begins to bend at x0 sags by A (u^4 - 4 l u^3 + 6 l^2 u^2), u = x - x0, l = L - x0.
    """
    free = clamped.along > 0.75 * clamped.scene.cell
    x = clamped.along[free]
    sag = -positions[free, 2]

    def misfit(offset: float) -> float:
        u = x - offset * clamped.scene.cell
        length = LENGTH - offset * clamped.scene.cell
        shape = u**4 - 4.0 * length * u**3 + 6.0 * length**2 * u**2
        amplitude = (shape @ sag) / (shape @ shape)
        return float(((sag - amplitude * shape) ** 2).sum())

    offsets = np.linspace(-1.5, 1.5, 601)
    return float(offsets[np.argmin([misfit(offset) for offset in offsets])])


def weight_of(ratio: float) -> float:
    """Return the weight rho g L^3 / D at which a cantilever has this drop over reach."""
    if not ratio > 0.0:
        raise NoValueError(f"the tip is at a drop over reach of {ratio:.3g}")
    low = np.log(WEIGHTS[0])
    high = np.log(WEIGHTS[1])
    if not master(WEIGHTS[0]) < ratio < master(WEIGHTS[1]):
        raise NoValueError(f"a drop over reach of {ratio:.3g} is far from that of weight {GAMMA:g}")
    # Regula falsi, halved on one side as in the Illinois rule, on logarithms: the curve is smooth.
    misses = [np.log(master(WEIGHTS[0]) / ratio), np.log(master(WEIGHTS[1]) / ratio)]
    for _ in range(40):
        middle = (low * misses[1] - high * misses[0]) / (misses[1] - misses[0])
        miss = np.log(master(float(np.exp(middle))) / ratio)
        if abs(miss) < 1e-9:
            break
        if miss > 0.0:
            high = middle
            misses = [0.5 * misses[0], miss]
        else:
            low = middle
            misses = [miss, 0.5 * misses[1]]
    return float(np.exp(middle))


@lru_cache(maxsize=64)
def elastica(gamma: float) -> Floats:
    """Return the angle of a cantilever at the Chebyshev points of its length, the clamp last: (N,).

        theta'' = -gamma (1 - s) cos(theta),   theta(0) = 0,   theta'(1) = 0

    by collocation and Newton's method. Its error is below 1e-9 up to a weight of 200.
    """
    points, derivative = chebyshev()
    second = derivative @ derivative
    theta = np.zeros(len(points))
    for _ in range(30):
        misses = second @ theta + gamma * (1.0 - points) * np.cos(theta)
        jacobian = second - np.diag(gamma * (1.0 - points) * np.sin(theta))
        # The first point is the free end, and the last one the clamp.
        misses[0] = derivative[0] @ theta
        jacobian[0] = derivative[0]
        misses[-1] = theta[-1]
        jacobian[-1] = np.eye(len(points))[-1]
        change = np.linalg.solve(jacobian, misses)
        # A long step would leave the branch that hangs down.
        theta = theta - change * min(1.0, 0.5 / np.abs(change).max())
        if np.abs(change).max() < 1e-12:
            return np.asarray(theta)
    raise ValueError(f"the elastica of weight {gamma} was not found")


@lru_cache
def chebyshev() -> tuple[Floats, Floats]:
    """Return the Chebyshev points of [0, 1] (N,), from 1 down to 0, and their derivative (N, N).

    [Trefethen 2000, ch. 6]
    """
    angles = np.pi * np.arange(POINTS) / (POINTS - 1)
    x = np.cos(angles)
    signs = (-1.0) ** np.arange(POINTS)
    signs[[0, -1]] *= 2.0
    distances = x[:, None] - x + np.eye(POINTS)
    matrix = np.outer(signs, 1.0 / signs) / distances
    matrix -= np.diag(matrix.sum(axis=1))
    return 0.5 * (x + 1.0), 2.0 * matrix


def line_of(gamma: float) -> tuple[Floats, Floats, Floats]:
    """Return arc length, x and z of a cantilever of length 1 at the Chebyshev points: (N,) each."""
    points, derivative = chebyshev()
    theta = elastica(gamma)
    # An integral from the clamp solves f' = g with f = 0 at the last point.
    system = derivative.copy()
    system[-1] = np.eye(len(points))[-1]
    slopes = np.column_stack([np.cos(theta), -np.sin(theta)])
    slopes[-1] = 0.0
    x, z = np.linalg.solve(system, slopes).T
    return points, x, z


@lru_cache(maxsize=1024)
def master(gamma: float) -> float:
    """Return the drop over reach of a cantilever of this weight."""
    _, x, z = line_of(gamma)
    return float(-z[0] / x[0])


def cantilever(laboratory: Laboratory, cells: int) -> Reading:
    """Measure the bending stiffness of a strip that is clamped horizontally."""
    bending = laboratory.softer * WEIGHT * LENGTH**2 / GAMMA
    clamped = strip(cells, min(ACROSS, cells // 3), STRETCHING * WEIGHT, bending)
    simulation = laboratory.open(clamped.scene)
    simulation.settle_gently(DAMPING)
    slightly = settled(simulation, LIGHT * DOWN, LENGTH, SETTLING)
    offset = clamp_offset(clamped, slightly)
    rest = settled(simulation, DOWN, LENGTH, SETTLING)
    reach, _, drop = rest[clamped.tip].mean(axis=0)
    gamma = weight_of(float(-drop / reach))
    middle = np.abs(clamped.scene.start[:, 1]) < 0.6 * clamped.scene.cell
    rows = np.unique(np.round(clamped.along[middle] / clamped.scene.cell, 3))
    line = []
    for row in rows:
        chosen = middle & (np.abs(clamped.along / clamped.scene.cell - row) < 0.01)
        line.append(rest[chosen].mean(axis=0))
    x, _, z = np.array(line).T
    return Reading(
        GAMMA / gamma,
        1.0,
        1e3 * x,
        1e3 * z,
        1e3 * np.interp(x, *heavy_line()),
        {"clamp behind its place [cells]": offset},
    )


@lru_cache
def heavy_line() -> tuple[Floats, Floats]:
    """Return x, ascending, and z of the cantilever of weight GAMMA [m]."""
    _, x, z = line_of(GAMMA)
    # Between the points, the picture draws straight lines.
    return LENGTH * x[::-1], LENGTH * z[::-1]


def lateral_buckling(laboratory: Laboratory, cells: int) -> Reading:
    """Measure the weight at which a strip on edge buckles, from deflections below it.

    A sideways load of 1e-3 of the weight deflects the tip by d, and 1/d falls to zero at the
    buckling weight. It is almost linear in the square of the weight [Southwell 1932].
    """
    bending = laboratory.softer * RIGIDITY
    gravity = BUCKLING * RIGIDITY / (DENSITY * LENGTH**3)
    stretching = IN_PLANE * DENSITY * gravity * LENGTH
    upright = strip(cells, max(2, round(ASPECT * (cells - 0.5))), stretching, bending, upright=True)
    simulation = laboratory.open(upright.scene)
    simulation.settle_gently(DAMPING)
    deflections = []
    for share in SHARES:
        load = gravity * np.array([0.0, SIDEWAYS, -share])
        rest = settled(simulation, load, LENGTH, SETTLING)
        deflections.append(rest[upright.tip, 1].mean())
    compliance = np.array(deflections)
    if not (compliance > 0.0).all():
        raise NoValueError("the strip does not deflect towards its sideways load")
    squares = np.array(SHARES) ** 2
    fit = np.polyfit(1.0 / compliance, squares, 2)
    if fit[-1] <= 0.0:
        raise NoValueError("the strip does not become softer sideways as its weight grows")
    buckling = float(np.sqrt(fit[-1]))
    x = np.array(SHARES)
    # The same stiffness against the sideways load, and the buckling weight of the plate.
    exact = compliance[0] * (1.0 - squares[0]) / (1.0 - squares)
    return Reading(buckling, 1.0, x, 1e3 * compliance, 1e3 * exact)


EXPERIMENTS = (
    Experiment(
        "cantilever",
        "Cantilever",
        "the elastica of weight rho g L^3/D = 10 [Romero et al. 2021]",
        "D that follows from the sag, over D",
        "",
        frozenset({"held"}),
        (10, 20, 40),
        ("x [mm]", "z [mm]"),
        cantilever,
    ),
    Experiment(
        "lateral-buckling",
        "A strip on edge buckles sideways",
        "the plate's buckling weight at w/L = 0.2, from deflections below it [Southwell 1932]",
        "buckling weight over the closed form",
        "",
        frozenset({"held"}),
        (10, 20, 40),
        ("weight over the buckling weight", "sideways deflection [mm]"),
        lateral_buckling,
    ),
)
