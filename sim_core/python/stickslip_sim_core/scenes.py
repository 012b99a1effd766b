"""What is simulated: cloth, what holds it, what it touches, and how these move."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core import cloth, fabrics, meshes
from stickslip_sim_core.presets import PRESETS, Preset

Floats = NDArray[np.float64]

SIDE = 0.2
"""Side of the square of cloth [m]."""

HOLDER = 0.01
"""Side of the square holders at two corners [m]."""

CLEARANCE = 0.01
"""Height of the lower edge over the floor at the start [m]."""

DROP, DRAG, LEGS = 0.06, 0.3, 4
"""Travel down, travel of each leg [m], and number of legs: there, back, there, back."""

SPEED, ACCELERATION = 0.01, 0.01
"""Of the motorised stages [m/s, m/s^2]."""

FRAME_RATE = 2.4
"""[1/s]"""


def travel(time: float, distance: float) -> float:
    """Return how far a stage has come that starts and ends at rest with `ACCELERATION` and cruises at `SPEED` [m]."""
    ramp = SPEED / ACCELERATION
    duration = duration_of(distance)
    t = min(max(time, 0.0), duration)
    if t < ramp:
        return 0.5 * ACCELERATION * t * t
    if t > duration - ramp:
        return distance - 0.5 * ACCELERATION * (duration - t) ** 2
    return SPEED * (t - 0.5 * ramp)


def duration_of(distance: float) -> float:
    """Return the time of a travel of at least SPEED^2 / ACCELERATION [s]."""
    return distance / SPEED + SPEED / ACCELERATION


def stage(time: float) -> Floats:
    """Return the displacement (x, z) of the holders [m]: down, then to and fro [thesis, 4.2.3]."""
    start, leg = duration_of(DROP), duration_of(DRAG)
    x, direction = 0.0, 1.0
    for i in range(LEGS):
        x += direction * travel(time - start - i * leg, DRAG)
        direction = -direction
    return np.array([x, -travel(time, DROP)])


DURATION = duration_of(DROP) + LEGS * duration_of(DRAG)
"""Of drop-and-drag [s]."""
