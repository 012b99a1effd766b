"""The time that a job still takes, from measured durations of tasks, with its uncertainty.

Let n_g be the number of tasks left of cost group g. Their durations have mean m_g and standard
deviation d_g over k_g measured tasks. With p slots to run them on,

    T     = sum_g n_g m_g / p,  but no less than  sum_s M_s  over the stages left, in sequence
    var T = sum_g (n_g d_g^2 + n_g^2 d_g^2 / k_g + n_g^2 m_g^2 f^2) / p^2

M_s is the mean duration of the tasks left of stage s. A running task that reports its progress
counts as the fraction of it that is left.

The three terms of the variance are the spread of the durations, the standard error of the mean, and
a relative error f. The model leaves out idle slots and other jobs, and f stands for them. The
interval is T -+ 1.28 sqrt(var T), which holds 80 % of a normal distribution.

The cost of a task is its share of the wall time of the call that made it. Only the whole call can
hang.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple, Self

from sqlalchemy import Connection
from stickslip_schemas.base import Stage
from stickslip_schemas.documents.responses import Eta
from stickslip_schemas.documents.tasks import TaskResult

from stickslip_services.database.statements import RowQuery, Statement
from stickslip_services.queue.rows import LeasedTask

QUANTILE_80 = 1.2816
MODEL_ERROR = 0.15  # f
PACK_GUESS = 5.0
"""Assumed duration of a pack or publish task until one has been measured [s]."""

MEASURED = 3
"""Number of measured calls of a group that make its cost known."""

LONG_CALL = 60.0
"""One call that takes longer than this [s] makes a cost known."""

KEPT_RUNS = 200
"""Number of tasks beyond which the sums of a group are halved, so that old measurements fade."""

TIMES = 3.0
"""Timeout of a call, as a multiple of its expected duration."""

Group = tuple[Stage, str, str]
"""Stage, kind and cost group."""


@dataclass(frozen=True, slots=True)
class StageTimings:
    """Durations of finished tasks: the number, their sum [s] and the sum of their squares [s^2]."""

    count: int
    total: float
    squares: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Self:
        return cls(len(seconds), sum(seconds), sum(each**2 for each in seconds))

    @property
    def mean(self) -> float:
        """Mean duration [s]."""
        return self.total / self.count

    @property
    def variance(self) -> float:
        """Variance of a duration [s^2].

        A single duration has its square as the variance.
        """
        if self.count < 2:
            return self.mean**2
        return max(0.0, (self.squares - self.total * self.mean) / (self.count - 1))


@dataclass(frozen=True, slots=True)
class Cost:
    """Measured durations of the tasks of a group: their shares, and the calls that made them."""

    share: StageTimings
    call: StageTimings

    @property
    def calls(self) -> float:
        """Number of measured calls.

        Each task has its fraction of the wall time of its call, and counts as that fraction of a
        call.
        """
        return self.share.count * self.share.total / max(self.call.total, 1e-9)

    @property
    def is_known(self) -> bool:
        """Whether enough calls have been measured.

        A call of many tasks is one measurement.
        """
        if self.share.count == 0:
            return False
        return self.calls > MEASURED - 0.5 or self.call.mean > LONG_CALL

    @property
    def expected_call(self) -> float:
        """Expected duration of a slow call [s]: the mean plus two standard deviations."""
        spread = self.call.variance if self.call.count > 1 else 0.0
        return float(self.call.mean + 2 * spread**0.5)


@dataclass(frozen=True, slots=True)
class StageWork:
    """Number of tasks left of a cost group, and the durations of such tasks so far.

    The durations are None if they are unknown.
    """

    left: float
    timings: StageTimings | None


def estimate(work: Mapping[Stage, Sequence[StageWork]], *, slots: int) -> Eta | None:
    """Return the time left, or None if it is unknown or nothing is left.

    Packing and publishing are a few short tasks at the end. Until such a task has been measured, it
    is assumed to take `PACK_GUESS`, with an error of 100 %. If the slowest measured group has a
    smaller mean, the guess is that mean. Simulations and renders are not guessed.
    """
    left = {
        stage: rest
        for stage, items in work.items()
        if (rest := [item for item in items if item.left > 0])
    }
    if not left or slots < 1:
        return None
    if any(
        item.timings is None
        for stage in (Stage.simulate, Stage.render)
        for item in left.get(stage, ())
    ):
        return None
    # Work that is done still tells how long tasks take, so take the timings of all items.
    measured = [
        item.timings for items in work.values() for item in items if item.timings is not None
    ]
    if not measured:
        return None
    longest = min(PACK_GUESS, max(timings.mean for timings in measured))
    # A variance of the mean squared is the error of 100 %.
    guess = StageTimings(1, longest, longest**2)
    seconds = chain = variance = 0.0
    for items in left.values():
        total = 0.0
        for item in items:
            timings = item.timings or guess
            n, mean, spread = item.left, timings.mean, timings.variance
            total += n * mean
            variance += (
                n * spread + n**2 * spread / timings.count + (n * mean * MODEL_ERROR) ** 2
            ) / slots**2
        seconds += total / slots
        # Stages follow each other, so even with many slots each one takes as long as a task of it.
        chain += total / max(1.0, sum(item.left for item in items))
    seconds = max(seconds, chain)
    margin = QUANTILE_80 * sqrt(variance)
    return Eta(seconds=seconds, low=max(0.0, seconds - margin), high=seconds + margin)


def pooled(costs: Mapping[Group, Cost], stage: Stage, kind: str) -> StageTimings | None:
    """Return the shares of all groups of a stage and kind together, as one measurement.

    Returns None if no group is known.
    """
    shares = [
        cost.share
        for (of_stage, of_kind, _), cost in costs.items()
        if (of_stage, of_kind) == (stage, kind) and cost.is_known
    ]
    if not shares:
        return None
    mean = sum(share.total for share in shares) / sum(share.count for share in shares)
    return StageTimings(1, mean, mean**2)


def known_timings(
    costs: Mapping[Group, Cost], stage: Stage, kind: str, group: str
) -> StageTimings | None:
    """Return the shares of a group, or None if too little is known of it.

    Other groups say nothing about a job that has not begun. For example, a frame of another quality
    costs several times as much.
    """
    cost = costs.get((stage, kind, group))
    return cost.share if cost is not None and cost.is_known else None


def timings_of(
    costs: Mapping[Group, Cost], stage: Stage, kind: str, group: str
) -> StageTimings | None:
    """Return the shares of a group, or of all groups of the stage and kind if too few are known."""
    cost = costs.get((stage, kind, group))
    if cost is not None and (cost.is_known or stage in (Stage.pack, Stage.publish)):
        return cost.share
    return pooled(costs, stage, kind)


class _CostRow(NamedTuple):
    """A row of `cost_groups`."""

    stage: str
    kind: str
    cost_group: str
    number: int
    wall_sum: float
    wall_squares: float
    call_sum: float
    call_squares: float


_COSTS = RowQuery(
    _CostRow,
    "SELECT stage, kind, cost_group, count, wall_sum, wall_squares, call_sum, call_squares "
    "FROM cost_groups",
)


def read_costs(connection: Connection) -> dict[Group, Cost]:
    """Return the measured durations of all cost groups."""
    costs: dict[Group, Cost] = {}
    for row in _COSTS.rows(connection):
        share = StageTimings(row.number, row.wall_sum, row.wall_squares)
        call = StageTimings(row.number, row.call_sum, row.call_squares)
        costs[Stage(row.stage), row.kind, row.cost_group] = Cost(share, call)
    return costs


def limit_seconds(cost: Cost | None, tries: int, *, floor: float) -> float | None:
    """Return the timeout of a call [s], at least `floor`, or None if the cost is unknown.

    Each failed try doubles it.
    """
    if cost is None or not cost.is_known:
        return None
    return float(max(floor, TIMES * cost.expected_call) * 2**tries)


def long_groups(
    costs: Mapping[Group, Cost], stage: Stage, kind: str, at_most: float | None
) -> list[str]:
    """Return the cost groups of a stage and kind whose calls take longer than `at_most` seconds."""
    if at_most is None:
        return []
    return [
        group
        for (of_stage, of_kind, group), cost in costs.items()
        if (of_stage, of_kind) == (stage, kind) and cost.is_known and cost.call.mean > at_most
    ]


class Run(NamedTuple):
    """An attempt of a task that ended with a result."""

    task: LeasedTask
    result: TaskResult


def add_costs(connection: Connection, runs: Sequence[Run]) -> None:
    """Add the costs of the tasks that succeeded and whose calls were measured.

    Rejections often come early, so they say little about the cost of a task.
    """
    runs_by_group: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for task, result in runs:
        if result.call_seconds is not None and result.outcome == "succeeded":
            group = runs_by_group.setdefault((task.stage, task.kind, task.cost_group), [])
            group.append((result.wall_seconds, result.call_seconds))
    rows: list[dict[str, object]] = []
    for (stage, kind, cost_group), seconds in runs_by_group.items():
        wall = StageTimings.of([wall_seconds for wall_seconds, _ in seconds])
        call = StageTimings.of([call_seconds for _, call_seconds in seconds])
        rows.append(
            {
                "stage": stage,
                "kind": kind,
                "cost_group": cost_group,
                "n": wall.count,
                "wall": wall.total,
                "wall2": wall.squares,
                "call": call.total,
                "call2": call.squares,
            }
        )
    _ADD_TO_COST_GROUPS.run_all(connection, rows)


_SUMS = ("count", "wall_sum", "wall_squares", "call_sum", "call_squares")
_DIVISOR = f"CASE WHEN cost_groups.count > {KEPT_RUNS} THEN 2 ELSE 1 END"
_FADED_SUMS = [
    f"{column} = cost_groups.{column} / ({_DIVISOR}) + excluded.{column}" for column in _SUMS
]
_ADD_TO_COST_GROUPS = Statement(
    f"INSERT INTO cost_groups (stage, kind, cost_group, {', '.join(_SUMS)}) "
    "VALUES (:stage, :kind, :cost_group, :n, :wall, :wall2, :call, :call2) "
    f"ON CONFLICT (stage, kind, cost_group) DO UPDATE SET {', '.join(_FADED_SUMS)}"
)
