"""Reference motions that repeat: a hanging chain that swings, and a block on a shaken floor.

They share no code with the solver of cloth.
"""

import math

import numpy as np

from stickslip_sim_core.arrays import Floats

GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""

FIRST_ZERO = 2.404825557695773
"""First zero of the Bessel function J0."""


def chain_period(length: float) -> float:
    """Return the period [s] of the slowest small swing of a chain [Bernoulli 1738; Euler 1781].

        T = (4 pi / j) sqrt(L/g),   j = 2.405, the first zero of the Bessel function J0

    Args:
        length: L [m].
    """
    return 4.0 * math.pi / FIRST_ZERO * math.sqrt(length / GRAVITY)


def chain_shape(below: Floats, length: float) -> Floats:
    """Return the displacement of that swing, 1 at the free end: (N,).

        J0(j sqrt(s/L))

    Args:
        below: Distance s from the free end: (N,) [m].
        length: L [m].
    """
    # Imported here, so that importing the package needs NumPy only.
    from scipy.special import j0

    return np.asarray(j0(FIRST_ZERO * np.sqrt(below / length)))


def shaken_block(
    frequency: float, size: float, mu: float, until: float, *, step: float = 2e-6
) -> float:
    """Return how far a block moves that lies on a floor which begins to shake at time 0 [m].

    The floor is at x_f = size (1 - cos(2 pi frequency t)). The block moves with the floor where
    friction can drive it so, and else with an acceleration of mu g along the slip. The motion is
    integrated with `step`: its error is below 2e-5 m after 0.3 s.

    Args:
        frequency: [1/s].
        size: Amplitude of the floor [m].
        mu: Coefficient of friction.
        until: Duration [s].
        step: [s].
    """
    omega = 2.0 * math.pi * frequency
    most = mu * GRAVITY * step
    position = speed = 0.0
    for tick in range(round(until / step)):
        # The mean velocity of the floor over the step.
        begin = omega * tick * step
        end = omega * (tick + 1) * step
        floor = size * (math.cos(begin) - math.cos(end)) / step
        speed += min(max(floor - speed, -most), most)
        position += speed * step
    return position
