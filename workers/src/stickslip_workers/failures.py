"""From exceptions to reason codes."""

from stickslip_schemas.base.states import Reason
from stickslip_schemas.documents.tasks import TaskResult
from stickslip_schemas.format.chunks import CorruptChunkError
from stickslip_schemas.store import is_unavailable

MESSAGE_LENGTH = 2000
"""The most that a result says of an error [characters]; the rest is in the log."""


def failed(reason: Reason, message: str) -> TaskResult:
    """Return the result of a task that the infrastructure failed."""
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
    """Return the result of a task whose process raised `error` through Ray, or died."""
    from ray import exceptions as ray_errors

    if isinstance(error, ray_errors.RayTaskError):
        # What was raised in the process; Ray leaves the traceback when the exception itself cannot travel.
        return failure(error.cause) if isinstance(error.cause, Exception) else failed(Reason.internal_error, str(error))
    if isinstance(error, ray_errors.OutOfMemoryError):
        return failed(Reason.oom_killed, str(error))
    # Where it is merely unavailable, the connection is lost, and Ray does not know of any death.
    is_node_lost = isinstance(error, ray_errors.ActorUnavailableError) or "its node has died" in str(error)
    if isinstance(error, ray_errors.RayActorError) and not is_node_lost:
        return failed(Reason.renderer_crash if renders else Reason.process_crash, str(error))
    return failed(Reason.worker_lost, str(error))
