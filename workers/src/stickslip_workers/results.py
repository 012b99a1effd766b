"""Results of tasks: reason codes from exceptions, and renders of one shading as one task."""

from collections.abc import Sequence

from stickslip_schemas.base import Reason, canonical_json
from stickslip_schemas.documents.tasks import RenderOutput, RenderTask, TaskResult
from stickslip_schemas.format.codecs import CorruptChunkError
from stickslip_schemas.store import is_unavailable

MESSAGE_LENGTH = 2000
"""Limit of the message of a result [characters]; the log has all of it."""


def failed(reason: Reason, message: str) -> TaskResult:
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


def process_failure(error: Exception, *, renders: bool) -> TaskResult:
    """Return the result of a task of Ray that raised `error`, or whose process or node died."""
    from ray import exceptions as ray_errors

    if isinstance(error, ray_errors.RayTaskError):
        # What was raised in the process; Ray leaves the traceback when the exception itself cannot travel.
        return failure(error.cause) if isinstance(error.cause, Exception) else failed(Reason.internal_error, str(error))
    if isinstance(error, ray_errors.OutOfMemoryError):
        return failed(Reason.oom_killed, str(error))
    if isinstance(error, ray_errors.WorkerCrashedError):
        return failed(Reason.renderer_crash if renders else Reason.process_crash, str(error))
    return failed(Reason.worker_lost, str(error))


def shading_of(task: RenderTask) -> str | None:
    """Return a key that renders of one shading share; None if a render shares none."""
    shared = task.render.shading
    return None if shared is None else canonical_json({"shading": shared, "record": task.record.model_dump()})


def merged(tasks: Sequence[RenderTask]) -> RenderTask:
    """Merge renders of one shading into one task; a single task stays as it is."""
    if len(tasks) == 1:
        return tasks[0]
    if len({shading_of(task) for task in tasks}) != 1 or shading_of(tasks[0]) is None:
        raise ValueError("tasks must be renders of one shading to be merged")
    textures = tuple(dict.fromkeys(task.render.variant for task in tasks))
    return tasks[0].model_copy(update={"textures": textures, "preview": any(task.preview for task in tasks)})


def split(tasks: Sequence[RenderTask], result: TaskResult) -> list[TaskResult]:
    """Split the result of merged renders into one a task; the cost is divided evenly."""
    if len(tasks) == 1:
        return [result]
    share = {"cpu_seconds": result.cpu_seconds / len(tasks), "wall_seconds": result.wall_seconds / len(tasks)}
    if not isinstance(result.output, RenderOutput):
        return [result.model_copy(update=share)] * len(tasks)
    try:
        return [_own(task, result.output.clips[task.render.variant]).model_copy(update=share) for task in tasks]
    except KeyError as error:
        return [failure(error)] * len(tasks)


def _own(task: RenderTask, result: TaskResult) -> TaskResult:
    if task.preview or not isinstance(result.output, RenderOutput):
        return result
    return result.model_copy(update={"output": result.output.model_copy(update={"preview": None})})
