"""The time that is left, from measured durations, with its uncertainty.

With n_s tasks left of stage s, whose durations have mean m_s and standard deviation d_s over k_s measured tasks, and
p slots to run them on,

    T     = sum_s n_s m_s / p,  but no less than  sum_s m_s  (over the stages that are left: one waits for the other)
    var T = sum_s (n_s d_s^2 + n_s^2 d_s^2 / k_s + n_s^2 m_s^2 f^2) / p^2

The three terms: the spread of what is to come, the error of a mean of few, and a relative error f for what the model
leaves out (slots that idle, other jobs). The interval is T -+ 1.28 sqrt(var T): 80 % of a normal distribution.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt

from stickslip_schemas.responses import Eta
from stickslip_schemas.states import Stage

QUANTILE_80 = 1.2816
MODEL_ERROR = 0.15  # f


@dataclass(frozen=True, slots=True)
class StageTimings:
    """Durations of finished tasks: how many, their sum [s] and the sum of their squares [s^2]."""

    count: int
    total: float
    squares: float

    @property
    def mean(self) -> float:
        """Mean duration [s]."""
        return self.total / self.count

    @property
    def variance(self) -> float:
        """Variance of a duration [s^2]; of a single one nothing is known, so it is taken as the mean squared."""
        if self.count < 2:
            return self.mean**2
        return max(0.0, (self.squares - self.total * self.mean) / (self.count - 1))


@dataclass(frozen=True, slots=True)
class StageWork:
    """Tasks that are left of a stage, and how long such tasks took so far (None: none has been measured)."""

    left: int
    timings: StageTimings | None


def estimate(work: Mapping[Stage, StageWork], *, slots: int) -> Eta | None:
    """Return the time that is left, or None where there is nothing to go by, or nothing left.

    Packing and publishing are a few short tasks at the end. Before the first of them has been measured they are taken
    to last as long as the longest task that has been, give or take all of it; simulations and renders are not guessed.
    """
    left = {stage: item for stage, item in work.items() if item.left}
    if not left or slots < 1:
        return None
    if any(item.timings is None for stage, item in left.items() if stage in (Stage.simulate, Stage.render)):
        return None
    measured = [item.timings for item in work.values() if item.timings is not None]
    if not measured:
        return None
    longest = max(timings.mean for timings in measured)
    guess = StageTimings(1, longest, longest**2)
    seconds = chain = variance = 0.0
    for item in left.values():
        timings = item.timings or guess
        n, mean, spread = item.left, timings.mean, timings.variance
        seconds += n * mean / slots
        chain += mean
        variance += (n * spread + n**2 * spread / timings.count + (n * mean * MODEL_ERROR) ** 2) / slots**2
    seconds = max(seconds, chain)
    margin = QUANTILE_80 * sqrt(variance)
    return Eta(seconds=seconds, low=max(0.0, seconds - margin), high=seconds + margin)
