"""The instant at which the cloth begins to slide.

A cloth that rests until t0 on a slope that grows with the speed w, and slides from then on, has
moved by

    s(t) = s0 + a (t - t0)^2 + b (t - t0)^3,   a >= 0,   b = g w / (6 cos(alpha)),   t > t0

until the motion of the tray changes. Here a is the fall of friction from static to kinetic, times
half of gravity, and b is the growth of the slope. The mean of the likelihood of t0 is the answer.
So the slide shows its beginning, long before an eye sees it. A sheet that is printed at another
scale changes b by as much, and t0 by less than a frame.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from stickslip_training.arrays import Floats

GRAVITY = 9.81
"""[m/s^2]"""
REST = 1.0
"""Time before the first clear motion that is looked at [s]."""
TRIALS = 4
"""Instants that are tried within the time of a frame."""
GROWTHS = (0.8, 0.9, 1.0, 1.1, 1.2)
"""Growths of the slope that are tried, over the one that is read: boards tell it to 10 %."""
NOISE_MIN = 5e-5
"""Least standard deviation of an offset that is believed [m]: a twentieth of a pixel."""
START_SD = 0.02
"""Standard deviation of an instant besides noise [s]: the error left in 40 rendered films that
judge nothing, where hand and cloth do not follow the law to the letter."""
FALL_MAX = 0.5
"""Largest fall of friction from static to kinetic, over the static one: in fabrics it is 0.3 or
less, and what jumps by more was not followed."""
CLEAR = 0.004
"""Offset that is clear motion [m]."""
FARTHEST = 0.02
"""Offset up to which the law is fitted [m]: a hand has not answered yet."""


@dataclass(frozen=True)
class Onset:
    """The beginning of a slide."""

    time: float
    """[s]"""
    sd: float
    """Standard deviation [s], with that of the clock of the frames."""
    rest: float
    """Offset before the slide [m]."""
    square: float
    """a [m/s^2]"""
    cube: float
    """b [m/s^3]"""

    def offsets(self, times: Floats) -> Floats:
        """Return the offsets of the law at times (N,) [m]."""
        since = np.clip(times - self.time, 0.0, None)
        return np.asarray(self.rest + self.square * since**2 + self.cube * since**3)


def square_max(angle: float) -> float:
    """Return the largest a [m/s^2] of a cloth that begins to slide at a tilt [rad]."""
    return FALL_MAX * GRAVITY * float(np.sin(angle)) / 2.0


def growth(angle: float, rate: float) -> float:
    """Return b [m/s^3] for a tilt [rad] that grows by a rate [rad/s]."""
    return GRAVITY * max(0.0, rate) / (6.0 * float(np.cos(angle)))


def clear_motion(offsets: Floats) -> int:
    """Return the first frame in which the cloth has clearly moved, by its offsets (N,) [m]."""
    resting = np.median(offsets[: max(1, len(offsets) // 4)])
    return int(np.argmax(offsets - resting > CLEAR))


def onset_of(times: Floats, offsets: Floats, cube: float) -> Onset:
    """Return the beginning of a slide from offsets (N,) [m] at times (N,) [s].

    `cube` is b [m/s^3].
    """
    clear = clear_motion(offsets)
    base = float(np.median(offsets[(times > times[clear] - REST) & (times < times[clear] - 0.2)]))
    used = (times > times[clear] - REST) & (offsets - base < FARTHEST)
    used &= np.arange(len(times)) <= clear + int(np.argmin(used[clear:]) or len(times))
    t, s = times[used], offsets[used]
    frame = float(np.median(np.diff(times)))
    trials = np.arange(t[0], t[-1], frame / TRIALS)
    fits = [[_fit(t, s, trial, share * cube) for trial in trials] for share in GROWTHS]
    costs = np.array([[cost for cost, _ in row] for row in fits])
    row, column = np.unravel_index(int(np.argmin(costs)), costs.shape)
    best, weights = fits[row][column]
    variance = max(NOISE_MIN**2, best / max(1, len(t) - 3))
    # The likelihood over the trials: its mean is the instant, and its width the error.
    chances = np.exp(-0.5 * (costs - best) / variance).sum(axis=0)
    mean = float(chances @ trials / chances.sum())
    spread = float(chances @ (trials - mean) ** 2 / chances.sum())
    sd = float(np.sqrt(spread + frame**2 / 12 + START_SD**2))
    rest = float(weights[0] - weights[1])
    return Onset(mean, sd, rest, float(weights[2]), GROWTHS[row] * cube)


def _fit(times: Floats, offsets: Floats, begin: float, cube: float) -> tuple[float, Floats]:
    """Return the sum of squares [m^2] and the weights of the law for an instant [s] and b."""
    since = np.clip(times - begin, 0.0, None)
    # A resting offset of either sign is two columns without a sign.
    columns = np.column_stack([np.ones(len(times)), -np.ones(len(times)), since**2])
    weights, misfit = nnls(columns, offsets - cube * since**3)
    return misfit**2, weights
