"""Sheets on a slope: onset, sliding, creep, stacks, and a sheet that slides out of a stack.

Gravity turns in place of the plane, so the floor stays z = 0. The slope goes down along a direction
that is parallel to no edge of a mesh: friction along an edge may differ from friction across.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from stickslip_sim_core.cloth import meshes

from stickslip_measure.contract import Body, Floats, Sheet
from stickslip_measure.laboratory import (
    DOWN,
    GRAVITY,
    Experiment,
    Laboratory,
    NoValueError,
    Reading,
    SleepError,
)
from stickslip_measure.process import FRAMES_AT_ONCE, Simulation

Numbers = NDArray[np.int32]

MU = 0.3
ROUGHER = 1.5  # friction of the floor below a stack, over mu
SIDE = 0.1  # m
DIRECTION = np.array([np.cos(0.5), np.sin(0.5)])  # down the slope

DENSITY = 0.2  # kg/m^2
STRETCHING = 100.0  # N/m
BENDING = 1e-5  # N m

SETTLING = 0.5  # s

RAMP = (0.9, 1.15)  # tan(alpha) over the value at slip
RATE = 0.025  # of the ramp [1/s]
FARTHEST = 0.02  # distance after which the ramp ends [m]
SLIDING = 0.02  # speed from which on the ramp is compared [m/s]
LEAST = 0.2  # friction that is searched, over the slope at which the ramp begins

KINETIC = 1.5  # tan(alpha) over mu
SLIDE = 0.5  # s
START = 0.1  # time after which the acceleration is measured [s]

HOLD = 0.9  # of the slip angle
HOLD_TIME = 10.0  # s
AWAKE = 0.01  # gravity changes by this share, so that a solver does not fall asleep
AWAKE_TIME = 0.5  # s

NUDGE = 0.2  # s
NUDGED = 0.5  # a woken sheet moves by at least this share of the closed form
ASLEEP = 1e-6  # a sheet that a nudge moves by less is not simulated [m]
HELD = 1e-4  # displacement in a hold beyond which cloth creeps, whatever a nudge does [m]


def tilted(slope: Floats | float, magnitude: float = GRAVITY) -> Floats:
    """Return gravity (..., 3) [m/s^2] in the axes of a plane of this tan(alpha)."""
    angle = np.arctan(slope)
    along = np.sin(angle)[..., None] * DIRECTION
    return np.asarray(magnitude * np.concatenate([along, -np.cos(angle)[..., None]], axis=-1))


def sheets(
    sizes: Sequence[tuple[float, float]],
    cell: float,
    laboratory: Laboratory,
    *,
    floor: float,
    friction: float | None = None,
    held: Sequence[int] = (),
) -> Sheet:
    """Return sheets on a floor and on each other, from the lowest upwards.

    Args:
        sizes: Widths and lengths [m].
        cell: Length of a cell [m].
        laboratory: It knows at which distances the simulator's sheets rest.
        floor: Friction of the floor.
        friction: Friction between sheets.
        held: Numbers of sheets whose edge against the slope is held.
    """
    parts = []
    starts = []
    numbers = []
    for number, (width, length) in enumerate(sizes):
        part = meshes.grid(width, length, round(width / cell), round(length / cell))
        height = laboratory.description.clearance + number * laboratory.description.gap
        parts.append(part)
        starts.append(np.column_stack([part.rest, np.full(len(part.rest), height)]))
        numbers.append(np.full(len(part.rest), number, dtype=np.int32))
    start = np.concatenate(starts)
    sheet = np.concatenate(numbers)
    whole = meshes.together(*parts)
    edges = [upper_edge(start, sheet, number) for number in held]
    for edge in edges:
        # A held edge in contact could press with any force.
        start[edge, 2] += LIFTED * laboratory.description.gap
    return Sheet(
        whole.rest,
        start,
        whole.triangles,
        sheet,
        cell,
        density=DENSITY,
        stretching=STRETCHING,
        bending=BENDING,
        held=np.concatenate([np.empty(0, dtype=np.int64), *edges]),
        bodies=(Body("plane", floor, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),),
        friction=friction,
        gap=laboratory.description.gap,
    )


def upper_edge(start: Floats, sheet: Numbers, number: int) -> NDArray[np.int64]:
    """Return the vertices of a sheet's edge that is highest on the slope."""
    x = np.where(sheet == number, start[:, 0], np.inf)
    return np.flatnonzero(x < x.min() + 1e-9)


def patch(laboratory: Laboratory, cells: int) -> Simulation:
    """Return a patch that lies on a floor."""
    scene = sheets([(SIDE, SIDE)], SIDE / cells, laboratory, floor=MU)
    simulation = laboratory.open(scene)
    simulation.rest(SETTLING, DOWN)
    return simulation


def slid(frames: Floats, start: Floats, sheet: Numbers, number: int) -> Floats:
    """Return the mean distance of a sheet down the slope at each frame: (N,) [m]."""
    chosen = sheet == number
    return np.asarray((frames[:, chosen, :2] - start[chosen, :2]).mean(axis=1) @ DIRECTION)


def speeds(slopes: Floats, frame: float, friction: float) -> Floats:
    """Return the speed of a rigid patch at the ends of steps on a growing slope: (N,) [m/s].

    v = int g (sin alpha - friction cos alpha) dt from tan(alpha) = friction on. The slope is
    constant in a step.
    """
    angle = np.arctan(slopes)
    acceleration = GRAVITY * (np.sin(angle) - friction * np.cos(angle))
    return np.asarray(np.cumsum(np.maximum(acceleration, 0.0)) * frame)


def distances(slopes: Floats, frame: float, friction: float) -> Floats:
    """Return the distance of a rigid patch at the ends of steps on a growing slope: (N,) [m]."""
    after = speeds(slopes, frame, friction)
    before = np.concatenate([[0.0], after[:-1]])
    return np.asarray(np.cumsum(0.5 * (before + after)) * frame)


def friction_of_ramp(slopes: Floats, frame: float, moved: Floats) -> float:
    """Return the friction for which a rigid patch has the measured mean speed on a growing slope.

    Speeds are differences of distances over two steps. Only those above `SLIDING` are compared, so
    a slow creep does not count as sliding.

    Args:
        slopes: tan(alpha) at the end of each step: (N,).
        frame: Time of a step [s].
        moved: Distance at the end of each step: (N,) [m].

    Raises:
        NoValueError: The patch never slides.
    """
    speed = (moved[2:] - moved[:-2]) / (2.0 * frame)
    sliding = speed > SLIDING
    if sliding.sum() < 4:
        raise NoValueError(
            f"no sliding up to {RAMP[1]:.2f} of the slope of slip: {1e3 * moved[-1]:.3g} mm"
        )
    # The mean over all of these steps is less noisy than the speed of one.
    target = float(speed[sliding].mean())

    def ideal(friction: float) -> float:
        distance = distances(slopes, frame, friction)
        return float(((distance[2:] - distance[:-2]) / (2.0 * frame))[sliding].mean())

    low = LEAST * float(slopes[0])
    high = float(slopes[-1])
    # A patch that slides before the ramp has a speed that no friction explains.
    if ideal(low) < target:
        raise NoValueError(
            f"it slides by {1e3 * moved[-1]:.3g} mm, and already below {slopes[0]:.3g}, where the "
            "slope begins to grow"
        )
    # The speed falls as friction grows.
    for _ in range(60):
        middle = 0.5 * (low + high)
        if ideal(middle) > target:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def ramped(simulation: Simulation, number: int, critical: float, below: int | None) -> Reading:
    """Let the slope grow, and return the slope at which a sheet slips over the closed form.

    Args:
        simulation: Sheets at rest.
        number: The sheet that slips.
        critical: tan(alpha) at which it should.
        below: A sheet that should stay, if there is one.
    """
    scene = simulation.scene
    assert isinstance(scene, Sheet)
    # The sheet takes up its weight on the slope before the slope grows.
    simulation.rest(SETTLING, tilted(np.array(RAMP[0] * critical)))
    start = simulation.positions
    steps = simulation.frames_in((RAMP[1] - RAMP[0]) / RATE)
    shares = RAMP[0] + (RAMP[1] - RAMP[0]) * np.arange(1, steps + 1) / steps
    moved = np.empty(0)
    # A sheet that has slid so far would soon leave the sheet below.
    while len(moved) < steps and moved.max(initial=0.0) < FARTHEST:
        batch = shares[len(moved) : len(moved) + FRAMES_AT_ONCE]
        frames = simulation.advance(tilted(critical * batch))
        moved = np.concatenate([moved, slid(frames, start, scene.sheet, number)])
        if below is not None:
            held = float(np.abs(slid(frames, start, scene.sheet, below)).max())
    shares = shares[: len(moved)]
    check_awake(simulation, number, float(moved[-1]))
    early = moved[shares < 0.99]
    details = {"moved at 0.99 of the slope [mm]": 1e3 * float(early[-1])}
    if below is not None:
        details["sheet below moved [mm]"] = 1e3 * held
    friction = friction_of_ramp(critical * shares, simulation.frame, moved)
    exact = distances(critical * shares, simulation.frame, critical)
    return Reading(friction / critical, 1.0, shares, 1e3 * moved, 1e3 * exact, details)


def check_awake(simulation: Simulation, number: int, moved: float) -> None:
    """Nudge a sheet that has not moved.

    Raises:
        SleepError: It does not move then either.
        NoValueError: It moves then, but far less than it should.
    """
    # A sheet that slides is awake.
    if moved > 1e-3:
        return
    check_nudge(nudged(simulation, number))


@dataclass(frozen=True)
class Nudge:
    """The answer of a sheet to a push along the slope."""

    distance: float
    """Mean distance [m]."""

    share: float
    """The distance over that of the closed form."""


def check_nudge(nudge: Nudge) -> None:
    """Refuse the answer of a sheet that does not slide when pushed.

    Raises:
        SleepError: It did not move: nothing is simulated.
        NoValueError: It moved, but far less than it should.
    """
    push = f"gravity along a slope of {2.0 * KINETIC:.1f} times the slip"
    if abs(nudge.distance) < ASLEEP:
        raise SleepError(f"{push} moved it by {1e3 * nudge.distance:.1g} mm")
    if nudge.share < NUDGED:
        raise NoValueError(f"it sticks: {push} moved it by {nudge.share:.2f} of the closed form")


def nudged(simulation: Simulation, number: int) -> Nudge:
    """Push a sheet along the slope for a moment, and return its answer.

    It speeds up with a = g (sin - mu cos) for a time t and slows down with mu g on the level:
    a t^2 / 2 + (a t)^2 / (2 mu g).
    """
    scene = simulation.scene
    assert isinstance(scene, Sheet)
    slope = 2.0 * KINETIC * MU
    angle = np.arctan(slope)
    start = simulation.positions
    simulation.rest(NUDGE, tilted(np.array(slope)))
    simulation.rest(SETTLING, DOWN)
    moved = float(slid(simulation.positions[None], start, scene.sheet, number)[0])
    acceleration = GRAVITY * (np.sin(angle) - MU * np.cos(angle))
    time = simulation.frames_in(NUDGE) * simulation.frame
    speed = acceleration * time
    return Nudge(moved, moved / (0.5 * speed * time + speed**2 / (2.0 * MU * GRAVITY)))


def incline_onset(laboratory: Laboratory, cells: int) -> Reading:
    """Measure the slope at which a patch slips."""
    return ramped(patch(laboratory, cells), 0, MU, None)


def kinetic(laboratory: Laboratory, cells: int) -> Reading:
    """Measure the friction of a patch that slides down a steep slope."""
    simulation = patch(laboratory, cells)
    scene = simulation.scene
    assert isinstance(scene, Sheet)
    start = simulation.positions
    slope = KINETIC * MU
    frames = simulation.rest(SLIDE, tilted(np.array(slope)))
    moved = slid(frames, start, scene.sheet, 0)
    time = simulation.times(len(frames))
    check_awake(simulation, 0, float(moved[-1]))
    late = time > START
    acceleration = 2.0 * float(np.polyfit(time[late], moved[late], 2)[0])
    angle = np.arctan(slope)
    measured = slope - acceleration / (GRAVITY * np.cos(angle))
    exact = 0.5 * GRAVITY * (np.sin(angle) - MU * np.cos(angle)) * time**2
    return Reading(measured / MU, 1.0, time, 1e3 * moved, 1e3 * exact)


def creep(laboratory: Laboratory, cells: int) -> Reading:
    """Measure how far a patch moves in ten seconds at 90 % of the angle of slip."""
    simulation = patch(laboratory, cells)
    scene = simulation.scene
    assert isinstance(scene, Sheet)
    start = simulation.positions
    steps = simulation.frames_in(HOLD_TIME)
    time = simulation.times(steps)
    # Gravity of changing size has the same angle, so a patch under Coulomb's law stays.
    size = 1.0 + AWAKE * (np.floor(time / AWAKE_TIME) % 2)
    slope = np.tan(HOLD * np.arctan(MU))
    frames = simulation.advance(size[:, None] * tilted(np.array(slope)))
    moved = slid(frames, start, scene.sheet, 0)
    # The larger of two components, as in the protocol `inclined-plane`.
    drift = float(np.abs(frames[-1] - start)[:, :2].max())
    nudge = nudged(simulation, 0)
    # A sheet that held may have been asleep, and one that crept may have fallen asleep.
    if drift < HELD or abs(nudge.distance) < ASLEEP:
        check_nudge(nudge)
    details = {"nudge over closed form": nudge.share}
    return Reading(1e3 * drift, 0.0, time, 1e3 * moved, np.zeros_like(time), details)


def stacked(laboratory: Laboratory, cells: int) -> Reading:
    """Measure the slope at which the upper of two sheets slips on the lower."""
    # The lower sheet is wider by a cell of the coarsest mesh, so its edge bears nothing.
    wider = 1.0 + 2.0 / 3.0
    scene = sheets(
        [(wider * SIDE, wider * SIDE), (SIDE, SIDE)],
        SIDE / cells,
        laboratory,
        floor=ROUGHER * MU,
        friction=MU,
    )
    simulation = laboratory.open(scene)
    simulation.rest(SETTLING, DOWN)
    return ramped(simulation, 1, MU, 0)


PULLED = 0.2  # friction of the stack from which the middle sheet slides out
LIFTED = 0.2  # height of a held edge over contact, over the gap
WIDTHS = (5.0 / 3.0, 4.0 / 3.0, 1.0)  # over the side, from the lowest sheet upwards


def pull_out(laboratory: Laboratory, cells: int) -> Reading:
    """Measure the slope at which the middle of three sheets slides out by its weight."""
    scene = sheets(
        [(width * SIDE, width * SIDE) for width in WIDTHS],
        SIDE / cells,
        laboratory,
        floor=1.0,
        friction=PULLED,
        held=(0, 2),
    )
    simulation = laboratory.open(scene)
    simulation.rest(SETTLING, DOWN)
    # The holder bears the weight of the edge of the upper sheet: half a cell of it.
    upper = WIDTHS[2] ** 2 * (1.0 - 0.5 / cells)
    middle = WIDTHS[1] ** 2
    critical = PULLED * (1.0 + 2.0 * upper / middle)
    return ramped(simulation, 1, critical, 0)


_SLOPE = ("tan(alpha) over the value at slip", "distance [mm]")
_TIME = ("time [s]", "distance [mm]")

EXPERIMENTS = (
    Experiment(
        "incline-onset",
        "Onset on a slope",
        "tan(alpha) = mu [Coulomb 1785]",
        "tan(alpha) at slip over mu",
        "",
        frozenset({"floor"}),
        (5, 10, 20),
        _SLOPE,
        incline_onset,
    ),
    Experiment(
        "kinetic-friction",
        "Sliding on a slope",
        "a = g (sin(alpha) - mu cos(alpha)), tan(alpha) = 1.5 mu",
        "kinetic friction over mu",
        "",
        frozenset({"floor"}),
        (5, 10, 20),
        _TIME,
        kinetic,
    ),
    Experiment(
        "creep",
        "Creep at 90 % of the angle of slip",
        "no motion in 10 s",
        "largest displacement of a vertex along x or y after 10 s; the curve is the mean distance "
        "down the slope",
        "mm",
        frozenset({"floor"}),
        (5, 10, 20),
        ("time [s]", "mean distance down the slope [mm]"),
        creep,
    ),
    Experiment(
        "stacked-incline",
        "A sheet on a sheet on a slope",
        "tan(alpha) = mu of the two sheets",
        "tan(alpha) at slip over mu",
        "",
        frozenset({"floor", "sheets"}),
        (3, 6, 9),
        _SLOPE,
        stacked,
    ),
    Experiment(
        "pull-out",
        "A sheet slides out of a stack",
        "tan(alpha) = mu (1 + 2 W_upper / W_middle)",
        "tan(alpha) at slip over the closed form",
        "",
        frozenset({"floor", "sheets", "held"}),
        (3, 6, 9),
        _SLOPE,
        pull_out,
    ),
)
