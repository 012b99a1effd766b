"""Run tasks in this process, simulations first of all.

This module turns exceptions into results, and measures time.
"""

import io
import logging
import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base import Reason
from stickslip_schemas.documents.tasks import (
    AnyTask,
    RecordRef,
    SimulateOutput,
    SimulateTask,
    TaskResult,
    input_digests,
    results_adapter,
    tasks_adapter,
)
from stickslip_schemas.format.codecs import CorruptChunkError
from stickslip_schemas.kinds import KINDS
from stickslip_schemas.scene.errors import UnfitStartError
from stickslip_schemas.store import Store, in_parallel, is_unavailable, open_store

from stickslip_workers.builds import kind, kind_builds, versions

if TYPE_CHECKING:
    from stickslip_sim_core.scenes.kind import Outcome

log = logging.getLogger(__name__)

frames: tuple[int, int] | None = None
"""Progress of the simulation in this process: frames done and frames in all.

None stands for no simulation that reports progress.
"""
MESSAGE_LENGTH = 2000
"""Limit of the message of a result [characters].

The log has the whole message.
"""
KEPT_BYTES = 256 * 2**20
"""Size of the records that are kept in memory [bytes]."""

Array = npt.NDArray[np.generic]


def encode_records(arrays: Mapping[str, Array]) -> bytes:
    """Return the file of `arrays`.

    The same arrays give the same bytes, because numpy dates every member 1980-01-01.
    """
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


class Records:
    """Reads records.

    An artifact that several slots share is read and checked once, as long as the memory has room
    for it.
    """

    def __init__(self, store: Store, *, kept_bytes: int = KEPT_BYTES) -> None:
        self._store = store
        self._artifacts: OrderedDict[str, dict[str, Array]] = OrderedDict()
        self._kept_bytes = kept_bytes
        self._bytes = 0

    def __call__(self, digest: str) -> dict[str, Array]:
        if digest in self._artifacts:
            self._artifacts.move_to_end(digest)
            return self._artifacts[digest]
        with np.load(io.BytesIO(self._store.read(digest)), allow_pickle=False) as arrays:
            artifact = self._artifacts[digest] = dict(arrays)
        self._bytes += _size(artifact)
        while self._bytes > self._kept_bytes and len(self._artifacts) > 1:
            self._bytes -= _size(self._artifacts.popitem(last=False)[1])
        return artifact


def _size(artifact: Mapping[str, Array]) -> int:
    return sum(values.nbytes for values in artifact.values())


class StageActor:
    """Runs simulate, pack and publish in a process that keeps it, with JSON on both sides."""

    def __init__(self, store: str) -> None:
        self._store = open_store(store)

    def describe(self) -> dict[str, Any]:
        return {"builds": {name: kind_builds(name) for name in KINDS}, "versions": versions()}

    def run(self, tasks: str) -> str:
        try:
            return results_adapter.dump_json(
                run_tasks(tasks_adapter.validate_json(tasks), self._store)
            ).decode()
        finally:
            global frames
            frames = None

    def frames(self) -> tuple[int, int] | None:
        """Return the progress of the running simulation, (frames done, frames total).

        Another thread may call it.
        """
        return frames


def run_tasks(tasks: Sequence[AnyTask], store: Store) -> list[TaskResult]:
    """Return one result for each task.

    `tasks` are simulations of one kind, or a single task of another stage. The cost of simulations
    that were solved together is divided among them.
    """
    cpu_begin = time.process_time()
    wall_begin = time.perf_counter()
    try:
        results = _run(tasks, store)
    # No error of a task may end this process. The log has its traceback, and the result reports it
    # with the task. A replay runs the task again.
    except Exception as error:
        log.exception("%s of %d tasks failed", tasks[0].stage, len(tasks))
        results = [with_damaged_inputs(failure(error), task, store) for task in tasks]
    cost_of_each = {
        "cpu_seconds": (time.process_time() - cpu_begin) / len(tasks),
        "wall_seconds": (time.perf_counter() - wall_begin) / len(tasks),
    }
    return [result.model_copy(update=cost_of_each) for result in results]


def with_damaged_inputs(result: TaskResult, task: AnyTask, store: Store) -> TaskResult:
    """Return the result of a failed task with the digests of its damaged inputs.

    They can then be recomputed at once. The function reads all inputs. While the store is
    unavailable, it cannot check them.
    """
    if result.reason is Reason.store_unavailable:
        return result
    digests = input_digests(task, store.read)
    are_whole = in_parallel(store.holds, digests)
    damaged = tuple(
        digest for digest, is_whole in zip(digests, are_whole, strict=True) if not is_whole
    )
    return result.model_copy(update={"damaged_inputs": damaged})


def _run(tasks: Sequence[AnyTask], store: Store) -> list[TaskResult]:
    """Run tasks of any stage.

    The module of another stage is imported here, because simulating needs no packer.
    """
    (stage,) = {task.stage for task in tasks}
    if stage == "simulate":
        return simulate([task for task in tasks if isinstance(task, SimulateTask)], store)
    work = getattr(import_module(f"stickslip_workers.stages.{stage}"), stage)
    return [TaskResult(outcome="succeeded", output=work(task, store)) for task in tasks]


def _set_frames(done: int, total: int) -> None:
    global frames
    frames = done, total


def simulate(tasks: Sequence[SimulateTask], store: Store) -> list[TaskResult]:
    """Simulate tasks of one kind together.

    Return one result for each. Raise ValueError for several kinds.
    """
    names = sorted({task.simulation.kind for task in tasks})
    if len(names) != 1:
        raise ValueError(f"tasks must be simulations of one kind; got {', '.join(names)}")
    simulated_kind = kind(names[0])
    try:
        simulations = [task.simulation.inputs(store.read) for task in tasks]
    except UnfitStartError as error:
        # Only scenes have a start that may be impossible, and each scene is a batch alone.
        return [_rejected(Reason.impossible_start, str(error))] * len(tasks)
    outcomes = simulated_kind.simulate(simulations, _set_frames)
    records = _store_records(outcomes, simulated_kind.batch, store)
    return [
        _rejection(physics, outcome)
        if outcome.reason
        else TaskResult(
            outcome="succeeded",
            output=SimulateOutput(record=records[number], labels=dict(outcome.labels)),
        )
        for number, (physics, outcome) in enumerate(zip(simulations, outcomes, strict=True))
    ]


def _store_records(outcomes: Sequence["Outcome"], batch: int, store: Store) -> dict[int, RecordRef]:
    """Store the records of valid outcomes, at most `batch` of the same shapes in an artifact.

    Return the places of the records.
    """
    alike: dict[Any, list[int]] = {}
    for number, outcome in enumerate(outcomes):
        if not outcome.reason:
            shapes = tuple((name, np.shape(values)) for name, values in outcome.record.items())
            alike.setdefault(shapes, []).append(number)
    records: dict[int, RecordRef] = {}
    for members in alike.values():
        for first in range(0, len(members), batch):
            numbers = members[first : first + batch]
            # One array has the values of all members, row by row.
            arrays: dict[str, Array] = {}
            for name in outcomes[numbers[0]].record:
                arrays[name] = np.stack([outcomes[number].record[name] for number in numbers])
            digest = store.publish(encode_records(arrays))
            for row, number in enumerate(numbers):
                records[number] = RecordRef(digest=digest, row=row)
    return records


def _rejection(physics: Mapping[str, Any], outcome: "Outcome") -> TaskResult:
    # People look for the sample by its numbers and names. Arrays would be unreadable in a sentence.
    values = []
    for name, value in physics.items():
        if isinstance(value, float):
            values.append(f"{name} = {value:g}")
        elif isinstance(value, int | str):
            values.append(f"{name} = {value}")
    numbers = ", ".join(values)
    return _rejected(Reason(outcome.code), f"{outcome.reason} at {numbers}")


def _rejected(reason: Reason, message: str) -> TaskResult:
    return TaskResult(outcome="rejected", reason=reason, message=message[:MESSAGE_LENGTH])


def failed(reason: Reason, message: str) -> TaskResult:
    """Return the result of a task that failed, for a reason of the infrastructure."""
    return TaskResult(outcome="failed", reason=reason, message=message[:MESSAGE_LENGTH])


def failure(error: Exception) -> TaskResult:
    """Return the result of a stage that raised `error`."""
    message = f"{type(error).__name__}: {error}"
    if isinstance(error, OSError) and is_unavailable(error):
        return failed(Reason.store_unavailable, message)
    if isinstance(error, OSError | CorruptChunkError):
        return failed(Reason.storage_error, message)
    if isinstance(error, MemoryError):
        return failed(Reason.oom_killed, message)
    return failed(Reason.internal_error, message)
