"""Simulate: from the physics of simulations to their records, for every kind."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from stickslip_schemas.base import Reason
from stickslip_schemas.documents.tasks import RecordRef, SimulateOutput, SimulateTask, TaskResult
from stickslip_schemas.store import Store

from stickslip_workers.kinds import kind
from stickslip_workers.progress import note
from stickslip_workers.stages.records import encode_records

if TYPE_CHECKING:
    from stickslip_sim_core.scenes.kind import Outcome


def simulate(tasks: Sequence[SimulateTask], store: Store) -> list[TaskResult]:
    """Simulate tasks of one kind together; return one result for each. Raise ValueError for several kinds."""
    names = sorted({task.simulation.kind for task in tasks})
    if len(names) != 1:
        raise ValueError(f"tasks must be simulations of one kind; got {', '.join(names)}")
    made = kind(names[0])
    simulations = [task.simulation.given(store.read) for task in tasks]
    outcomes = made.simulate(simulations, note)
    records = _stored(outcomes, made.batch, store)
    return [
        _rejection(physics, outcome)
        if outcome.reason
        else TaskResult(outcome="succeeded", output=SimulateOutput(record=records[number], labels=dict(outcome.labels)))
        for number, (physics, outcome) in enumerate(zip(simulations, outcomes, strict=True))
    ]


def _stored(outcomes: Sequence["Outcome"], batch: int, store: Store) -> dict[int, RecordRef]:
    """Store the records of valid outcomes, at most `batch` of the same shapes in an artifact; return where they are."""
    alike: dict[Any, list[int]] = {}
    for number, outcome in enumerate(outcomes):
        if not outcome.reason:
            shapes = tuple((name, np.shape(values)) for name, values in outcome.record.items())
            alike.setdefault(shapes, []).append(number)
    found: dict[int, RecordRef] = {}
    for members in alike.values():
        for first in range(0, len(members), batch):
            some = members[first : first + batch]
            arrays = {name: np.stack([outcomes[n].record[name] for n in some]) for name in outcomes[some[0]].record}
            digest = store.publish(encode_records(arrays))
            found |= {number: RecordRef(digest=digest, row=row) for row, number in enumerate(some)}
    return found


def _rejection(physics: Mapping[str, Any], outcome: "Outcome") -> TaskResult:
    shown = {name: f"{value:g}" if isinstance(value, float) else value for name, value in physics.items()}
    numbers = ", ".join(f"{name} = {value}" for name, value in shown.items() if isinstance(value, int | str))
    return TaskResult(outcome="rejected", reason=Reason(outcome.code), message=f"{outcome.reason} at {numbers}")
