"""From exceptions to reason codes."""

from stickslip_schemas.chunks import CorruptChunkError
from stickslip_schemas.states import Reason
from stickslip_schemas.tasks import TaskResult

MESSAGE_LENGTH = 2000
"""The most that a result says of an error [characters]; the rest is in the log."""


def failed(reason: Reason, message: str) -> TaskResult:
    """Return the result of a task that the infrastructure failed."""
    return TaskResult(outcome="failed", reason=reason, message=message[:MESSAGE_LENGTH])


def failure(error: Exception) -> TaskResult:
    """Return the result of a stage that raised `error`."""
    message = f"{type(error).__name__}: {error}"
    if isinstance(error, OSError | CorruptChunkError):
        return failed(Reason.storage_error, message)
    if isinstance(error, MemoryError):
        return failed(Reason.oom_killed, message)
    return failed(Reason.internal_error, message)
