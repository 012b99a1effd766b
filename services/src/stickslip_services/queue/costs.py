"""What tasks cost, by stage, kind and cost group, and what follows: limits, and which tasks are long.

A task's share is the wall time of the call that made it over the tasks of that call; the call is what can hang.
"""

from collections.abc import Mapping, Sequence

from sqlalchemy import Connection, select
from stickslip_schemas.base.states import Stage

from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import cost_groups
from stickslip_services.queue.eta import Cost, Group, Run, StageTimings

KEPT_RUNS = 200
"""Beyond so many tasks of a group the sums are halved: what was measured long ago fades."""

_ALL_COSTS = Prepared(select(cost_groups))

TIMES = 3.0
"""A call is ended after so many times what it is expected to take."""


def read_costs(connection: Connection) -> dict[Group, Cost]:
    """Return what tasks cost so far."""
    return {
        (Stage(stage), kind, group): Cost(
            StageTimings(count, wall_sum, wall_squares), StageTimings(count, call_sum, call_squares)
        )
        for stage, kind, group, count, wall_sum, wall_squares, call_sum, call_squares in _ALL_COSTS.tuples(connection)
    }


def limit_seconds(cost: Cost | None, tries: int, *, floor: float) -> float | None:
    """Return after what time to end a call [s], at least `floor`; each failed try doubles it. None: it is not known."""
    if cost is None or not cost.is_known:
        return None
    return float(max(floor, TIMES * cost.expected_call) * 2**tries)


def long_groups(costs: Mapping[Group, Cost], stage: Stage, kind: str, at_most: float | None) -> list[str]:
    """Return the cost groups of a stage and kind whose calls take longer than `at_most` seconds."""
    if at_most is None:
        return []
    return [
        group
        for (of_stage, of_kind, group), cost in costs.items()
        if (of_stage, of_kind) == (stage, kind) and cost.is_known and cost.call.mean > at_most
    ]


def add_costs(connection: Connection, runs: Sequence[Run]) -> None:
    """Note what tasks have cost; of a call that is not to be gone by nothing is noted."""
    by_group: dict[Group, list[tuple[float, float]]] = {}
    for run in runs:
        if run.call_seconds is not None:
            by_group.setdefault((run.stage, run.kind, run.cost_group), []).append((run.wall_seconds, run.call_seconds))
    for (stage, kind, group), costs in by_group.items():
        _ADD_TO_COST_GROUPS.run(
            connection,
            {
                "stage": stage,
                "kind": kind,
                "cost_group": group,
                "n": len(costs),
                "wall": sum(wall for wall, _ in costs),
                "wall2": sum(wall**2 for wall, _ in costs),
                "call": sum(call for _, call in costs),
                "call2": sum(call**2 for _, call in costs),
            },
        )


_SUMS = ("wall_sum", "wall_squares", "call_sum", "call_squares")


def _faded(column: str) -> str:
    keep = f"CASE WHEN cost_groups.count > {KEPT_RUNS} THEN 2 ELSE 1 END"
    return f"{column} = cost_groups.{column} / ({keep}) + excluded.{column}"


_ADD_TO_COST_GROUPS = Prepared(
    "INSERT INTO cost_groups (stage, kind, cost_group, count, wall_sum, wall_squares, call_sum, call_squares) "
    "VALUES (:stage, :kind, :cost_group, :n, :wall, :wall2, :call, :call2) "
    "ON CONFLICT (stage, kind, cost_group) DO UPDATE SET " + ", ".join(_faded(column) for column in ("count", *_SUMS))
)
