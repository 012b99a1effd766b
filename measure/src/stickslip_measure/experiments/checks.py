"""Checks before all experiments: does a patch fall as it must, and where is its mass?

They need no friction and no bending. A fault that they find explains wrong values elsewhere.
"""

import numpy as np
from stickslip_sim_core.cloth import meshes

from stickslip_measure.contract import Sheet
from stickslip_measure.laboratory import DOWN, GRAVITY, Experiment, Laboratory, Reading, settled

SIDE = 0.1  # m
DENSITY = 0.2  # kg/m^2
STRETCHING = 100.0  # N/m
STIFF = 1e-3  # N m

DURATION = 0.3  # s

WIDE = 0.06  # m
HIGH = 0.04  # m
FINE = 6  # cells in the left half of the hung plate
COARSE = 2  # cells in its right half
DAMPING = 10.0  # 1/s
SETTLING = 12.0  # longest time of settling [s]


def fall(laboratory: Laboratory, cells: int) -> Reading:
    """Measure the acceleration of a patch that falls freely."""
    mesh = meshes.grid(SIDE, SIDE, cells, cells)
    scene = Sheet(
        mesh.rest,
        np.column_stack([mesh.rest, np.zeros(len(mesh.rest))]),
        mesh.triangles,
        np.zeros(len(mesh.rest), dtype=np.int32),
        mesh.spacing,
        density=DENSITY,
        stretching=STRETCHING,
        bending=1e-5,
    )
    simulation = laboratory.open(scene)
    # Positions in another unit show before the first step.
    scale = float(np.linalg.norm(simulation.positions) / np.linalg.norm(scene.start))
    frames = simulation.rest(DURATION, DOWN)
    time = simulation.times(len(frames))
    height = frames[:, :, 2].mean(axis=1)
    half = len(time) // 2
    details = {"size at the start over the scene's": scale}
    # A curve needs some points.
    if half > 3:
        early = np.polyfit(time[:half], height[:half], 2)[0]
        late = np.polyfit(time[half:], height[half:], 2)[0]
        details["late over early acceleration"] = float(late / early)
    acceleration = -2.0 * float(np.polyfit(time, height, 2)[0])
    exact = -0.5 * GRAVITY * time**2
    return Reading(acceleration / GRAVITY, 1.0, time, 1e3 * height, 1e3 * exact, details)


def balance(laboratory: Laboratory, cells: int) -> Reading:
    """Measure the tilt of a plate that hangs by the middle of its upper edge.

    Its mesh is fine on the left and coarse on the right, so equal masses of all vertices tilt it.
    """
    left = np.linspace(-0.5 * WIDE, 0.0, FINE + 1)
    right = np.linspace(0.0, 0.5 * WIDE, COARSE + 1)[1:]
    x = np.concatenate([left, right])
    regular = meshes.grid(1.0, HIGH, len(x) - 1, cells)
    rest = np.column_stack([np.tile(x, cells + 1), regular.rest[:, 1]])
    top = 0.5 * HIGH
    hook = np.flatnonzero((np.abs(rest[:, 0]) < 1e-9) & (rest[:, 1] > top - 1e-9))
    start = np.column_stack([rest[:, 0], np.zeros(len(rest)), rest[:, 1]])
    scene = Sheet(
        rest,
        start,
        regular.triangles,
        np.zeros(len(rest), dtype=np.int32),
        HIGH / cells,
        density=DENSITY,
        stretching=STRETCHING,
        bending=STIFF,
        held=hook,
    )
    simulation = laboratory.open(scene)
    simulation.settle_gently(DAMPING)
    still = settled(simulation, DOWN, WIDE, SETTLING)
    centre_before = start - start.mean(axis=0)
    centre_after = still - still.mean(axis=0)
    # The angle of the best rotation in the plane of the plate.
    turn = centre_before[:, 0] @ centre_after[:, 2] - centre_before[:, 2] @ centre_after[:, 0]
    along = centre_before[:, 0] @ centre_after[:, 0] + centre_before[:, 2] @ centre_after[:, 2]
    tilt = np.tan(np.arctan2(turn, along))
    # The tilt that brings the mean of the vertices below the hook.
    equal = rest[:, 0].mean() / (rest[:, 1].mean() - top)
    edge = rest[:, 1] < 1e-9 - 0.5 * HIGH
    return Reading(
        float(tilt / equal),
        0.0,
        1e3 * still[edge, 0],
        1e3 * still[edge, 2],
        1e3 * start[edge, 2],
    )


CHECKS = (
    Experiment(
        "fall",
        "A patch falls",
        "z = -g t^2/2",
        "acceleration over g",
        "",
        frozenset(),
        (4,),
        ("time [s]", "height [mm]"),
        fall,
    ),
    Experiment(
        "balance",
        "A plate hangs level",
        "its centre of mass is below the hook",
        "tilt over that of equal vertex masses",
        "of the tilt",
        frozenset({"held"}),
        (4,),
        ("x [mm]", "height of the lower edge [mm]"),
        balance,
    ),
)
