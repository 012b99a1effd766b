"""What tasks cost, and the time that is left, from measured durations, with its uncertainty.

With n_g tasks left of cost group g, whose durations have mean m_g and standard deviation d_g over k_g measured tasks,
and p slots to run them on,

    T     = sum_g n_g m_g / p,  but no less than  sum_s M_s  (over the stages that are left: one waits for the other)
    var T = sum_g (n_g d_g^2 + n_g^2 d_g^2 / k_g + n_g^2 m_g^2 f^2) / p^2

where M_s is the mean duration of what is left of stage s. A task that runs and tells counts as what is left of it.

The three terms: the spread of what is to come, the error of a mean of few, and a relative error f for what the model
leaves out (slots that idle, other jobs). The interval is T -+ 1.28 sqrt(var T): 80 % of a normal distribution.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

from stickslip_schemas.base.states import Stage
from stickslip_schemas.documents.responses import Eta

QUANTILE_80 = 1.2816
MODEL_ERROR = 0.15  # f
PACK_GUESS = 5.0
"""How long a pack or publish task takes before one was measured [s]."""


MEASURED = 3
"""Tasks of a group that must have been measured before their cost is gone by."""

LONG_CALL = 60.0
"""Of calls that take longer [s] one is enough to go by."""

Group = tuple[Stage, str, str]
"""Stage, kind and cost group."""


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
class Run:
    """A task that was really run: what it cost."""

    task: int
    stage: Stage
    kind: str
    cost_group: str
    cpu_seconds: float
    wall_seconds: float
    """Its share of the call that made it."""
    call_seconds: float | None
    """The whole call; None where it is not to be gone by."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Measured durations of the tasks of a group: their shares, and the calls that made them."""

    share: StageTimings
    call: StageTimings

    @property
    def is_known(self) -> bool:
        """True where there is enough to go by."""
        return self.share.count >= MEASURED or (self.share.count > 0 and self.call.mean > LONG_CALL)

    @property
    def expected_call(self) -> float:
        """How long a call may well take [s]: the mean and two standard deviations."""
        spread = self.call.variance if self.call.count > 1 else 0.0
        return float(self.call.mean + 2 * spread**0.5)


@dataclass(frozen=True, slots=True)
class StageWork:
    """Tasks that are left of a cost group, and how long such tasks took so far (None: it is not known)."""

    left: float
    timings: StageTimings | None


def estimate(work: Mapping[Stage, Sequence[StageWork]], *, slots: int) -> Eta | None:
    """Return the time that is left, or None where there is nothing to go by, or nothing left.

    Packing and publishing are a few short tasks at the end. Before the first of them has been measured they are taken
    to last `PACK_GUESS`, or as long as the longest task that has been where that is less, give or take all of it;
    simulations and renders are not guessed.
    """
    left = {stage: rest for stage, items in work.items() if (rest := [item for item in items if item.left > 0])}
    if not left or slots < 1:
        return None
    if any(item.timings is None for stage in (Stage.simulate, Stage.render) for item in left.get(stage, ())):
        return None
    measured = [item.timings for items in work.values() for item in items if item.timings is not None]
    if not measured:
        return None
    longest = min(PACK_GUESS, max(timings.mean for timings in measured))
    guess = StageTimings(1, longest, longest**2)
    seconds = chain = variance = 0.0
    for items in left.values():
        total = 0.0
        for item in items:
            timings = item.timings or guess
            n, mean, spread = item.left, timings.mean, timings.variance
            total += n * mean
            variance += (n * spread + n**2 * spread / timings.count + (n * mean * MODEL_ERROR) ** 2) / slots**2
        seconds += total / slots
        chain += total / max(1.0, sum(item.left for item in items))
    seconds = max(seconds, chain)
    margin = QUANTILE_80 * sqrt(variance)
    return Eta(seconds=seconds, low=max(0.0, seconds - margin), high=seconds + margin)


def pooled(costs: Mapping[Group, Cost], stage: Stage, kind: str) -> StageTimings | None:
    """Return the shares of all groups of a stage and kind together, as one measurement; None where none is known."""
    found = [
        cost.share
        for (of_stage, of_kind, _), cost in costs.items()
        if (of_stage, of_kind) == (stage, kind) and cost.is_known
    ]
    if not found:
        return None
    mean = sum(share.total for share in found) / sum(share.count for share in found)
    return StageTimings(1, mean, mean**2)
