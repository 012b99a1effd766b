"""Cards: a house of cards that is pushed over, and a card between two fingers."""

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

LENGTH = 0.1  # of a card [m]
BREADTH = 0.6  # of a card, over its length
DENSITY = 0.2  # kg/m^2
STIFF = 1e-2  # bending stiffness of a card: softer cards sag, which moves their thrust [N m]
STRETCHING = 1e3  # N/m

FRICTION = (0.3, 0.5, 0.7)
MARGIN = 1.1  # friction over what the house needs without a push
SETTLING = 0.3  # s
PUSHED = 1.25  # largest friction that the push asks for, over mu
RATE = 0.02  # growth of the push over gravity [1/s]
COLLAPSED = 0.005  # displacement of a foot that is no slip any more [m]
SLIP = (2e-5, 3e-4)
"""Displacements of a foot from which its onset is extrapolated [m].

A foot that has slid further needs more friction, and so slides faster than the push grows.
"""


def lean(mu: float) -> float:
    """Return the angle of the cards from the vertical [rad] at which they need mu / MARGIN.

    Each foot bears the weight W of a card and the thrust W tan(angle)/2.
    """
    return float(np.arctan(2.0 * mu / MARGIN))


def needed(push: Floats | float, angle: float) -> Floats:
    """Return the friction that the foot needs at which a house slips first: (N,).

    The house is an arch of three hinges: two feet, and the edge at which the cards meet. A push of
    `push` times the weight, towards the foot, adds to its thrust and to its load:

        (t + push) / (1 + push / (4 t)),   t = tan(angle)/2.
    """
    t = 0.5 * np.tan(angle)
    return np.asarray((t + push) / (1.0 + push / (4.0 * t)))


def house(laboratory: Laboratory, cells: int, mu: float) -> Sheet:
    """Return two cards that lean on each other."""
    angle = lean(mu)
    across = round(BREADTH * cells)
    card = meshes.grid(BREADTH * LENGTH, LENGTH, across, cells)
    cell = LENGTH / cells
    up = card.rest[:, 1] - card.rest[:, 1].min()
    gap = laboratory.description.gap
    # The upper edges are a gap apart.
    x = 0.5 * gap + (LENGTH - up) * np.sin(angle)
    z = laboratory.description.clearance + up * np.cos(angle)
    left = np.column_stack([-x, card.rest[:, 0], z])
    # The second card is shifted, so that its vertices meet no vertex.
    right = np.column_stack([x, card.rest[:, 0] + 0.3 * cell, z])
    both = meshes.together(card, card)
    return Sheet(
        both.rest,
        np.concatenate([left, right]),
        both.triangles,
        np.repeat(np.arange(2, dtype=np.int32), len(up)),
        cell,
        density=DENSITY,
        stretching=STRETCHING,
        bending=STIFF,
        bodies=(Body("plane", mu, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),),
        friction=mu,
        gap=gap,
    )


def house_of_cards(laboratory: Laboratory, cells: int) -> Reading:
    """Measure the push at which a house of cards slips, as the friction that it needs."""
    ratios = []
    for mu in FRICTION:
        ratios.append(pushed(laboratory, cells, mu) / mu)
    mus = np.array(FRICTION)
    return Reading(
        float(np.mean(ratios)),
        1.0,
        mus,
        mus * ratios,
        mus,
        {f"at mu {mu:g}": ratio for mu, ratio in zip(FRICTION, ratios, strict=True)},
    )


def pushed(laboratory: Laboratory, cells: int, mu: float) -> float:
    """Return the friction that a house needs at the push at which it slips.

    Raises:
        NoValueError: It collapses without a push, or does not slip.
    """
    scene = house(laboratory, cells, mu)
    angle = lean(mu)
    simulation = laboratory.open(scene)
    # Cards that are laid against each other ring for a moment.
    simulation.settle_gently(10.0)
    simulation.rest(SETTLING, DOWN)
    simulation.settle_gently(0.0)
    foot = np.flatnonzero(scene.start[:, 0] > scene.start[:, 0].max() - 1e-9)
    moved = simulation.positions[foot, 0].mean() - scene.start[foot, 0].mean()
    if moved > COLLAPSED:
        raise NoValueError(
            f"the house of mu {mu:g} collapses: a foot slides {1e3 * moved:.3g} mm, and it needs "
            f"only {mu / MARGIN:.3g}"
        )
    # The largest push is that at which it needs PUSHED mu.
    t = 0.5 * np.tan(angle)
    largest = (PUSHED * mu - t) / (1.0 - PUSHED * mu / (4.0 * t))
    steps = simulation.frames_in(largest / RATE)
    pushes = largest * np.arange(1, steps + 1) / steps
    gravity = GRAVITY * np.column_stack([pushes, np.zeros(steps), -np.ones(steps)])
    first = simulation.positions[foot, 0].mean()
    frames = simulation.advance(gravity)
    slip = frames[:, foot, 0].mean(axis=1) - first
    chosen = (slip > SLIP[0]) & (slip < SLIP[1])
    if slip[-1] < COLLAPSED or chosen.sum() < 2:
        raise NoValueError(
            f"the house of mu {mu:g} still stands at a push that needs {PUSHED:g} mu"
        )
    # Distance grows with the third power of the time since the slip, as the push grows with it.
    root = np.polyfit(np.cbrt(slip[chosen]), pushes[chosen], 1)[1]
    return float(needed(root, angle))


GRIP = 0.3  # friction of the fingers
SQUEEZED = 300.0  # stretching stiffness of the card between the fingers [N/m]
LIFTED = 1e-3  # its bending stiffness: it buckles under three times the grip [N m]
LOAD = (0.9, 1.1)  # weight over the weight that slips
LOAD_RATE = 0.04  # of the load [1/s]
FALLEN = (5e-5, 0.02)  # distances of the card from which its onset is extrapolated [m]


def pinch(laboratory: Laboratory, cells: int) -> Reading:
    """Measure the weight at which a card slips out between two fingers.

    The fingers squeeze it by a strain e, so each presses with Y e and bears mu Y e per breadth.
    Gravity grows until the card slips.
    """
    card = meshes.grid(LENGTH, BREADTH * LENGTH, cells, round(BREADTH * cells))
    strain = DENSITY * GRAVITY * LENGTH / (2.0 * GRIP * SQUEEZED)
    start = np.column_stack(
        [(1.0 - strain) * card.rest[:, 0], np.zeros(len(card.rest)), card.rest[:, 1]]
    )
    reach = 0.5 * (1.0 - strain) * LENGTH + laboratory.description.clearance
    scene = Sheet(
        card.rest,
        start,
        card.triangles,
        np.zeros(len(start), dtype=np.int32),
        card.spacing,
        density=DENSITY,
        stretching=SQUEEZED,
        bending=LIFTED,
        bodies=(
            Body("plane", GRIP, (-reach, 0.0, 0.0), (1.0, 0.0, 0.0)),
            Body("plane", GRIP, (reach, 0.0, 0.0), (-1.0, 0.0, 0.0)),
        ),
    )
    simulation = laboratory.open(scene)
    simulation.settle_gently(10.0)
    simulation.rest(SETTLING, LOAD[0] * DOWN)
    simulation.settle_gently(0.0)
    first = simulation.positions[:, 2].mean()
    if start[:, 2].mean() - first > COLLAPSED:
        raise NoValueError(f"the card falls at {LOAD[0]:g} of the load that slips")
    steps = simulation.frames_in((LOAD[1] - LOAD[0]) / LOAD_RATE)
    loads = LOAD[0] + (LOAD[1] - LOAD[0]) * np.arange(1, steps + 1) / steps
    frames = simulation.advance(loads[:, None] * DOWN)
    fallen = first - frames[:, :, 2].mean(axis=1)
    chosen = (fallen > FALLEN[0]) & (fallen < FALLEN[1])
    if chosen.sum() < 2:
        raise NoValueError(
            f"the card still hangs at {LOAD[1]:g} of the load that slips: {1e3 * fallen[-1]:.3g} mm"
        )
    # The weight beyond the grip grows with time, and the distance with its third power.
    load = float(np.polyfit(np.cbrt(fallen[chosen]), loads[chosen], 1)[1])
    rate = LOAD_RATE * GRAVITY
    exact = rate * (np.maximum(loads - 1.0, 0.0) / LOAD_RATE) ** 3 / 6.0
    return Reading(load, 1.0, loads, 1e3 * fallen, 1e3 * exact)


EXPERIMENTS = (
    Experiment(
        "house-of-cards",
        "A house of cards is pushed over",
        "mu = (t + push) / (1 + push / (4 t)), t = tan(angle)/2, at mu 0.3, 0.5, 0.7",
        "friction that it needs when it slips, over mu",
        "",
        frozenset({"floor", "sheets"}),
        (5, 10, 15),
        ("mu", "friction at slip"),
        house_of_cards,
    ),
    Experiment(
        "pinch",
        "A card between two fingers",
        "weight = 2 mu Y strain",
        "load at slip over the closed form",
        "",
        frozenset({"planes", "curved"}),
        (5, 10, 20),
        ("weight over the closed form", "distance [mm]"),
        pinch,
    ),
)
