"""Failures: every way to end badly has its reason."""

import errno

import pytest
from ray import exceptions as ray_errors
from stickslip_schemas.base.states import Reason
from stickslip_schemas.format.chunks import CorruptChunkError
from stickslip_schemas.store import CorruptArtifactError
from stickslip_workers.failures import MESSAGE_LENGTH, failure, process_failure


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), Reason.store_unavailable),
        (PermissionError(errno.EACCES, "Permission denied"), Reason.store_unavailable),
        (OSError(errno.EROFS, "Read-only file system"), Reason.store_unavailable),
        (OSError(errno.EIO, "Input/output error"), Reason.storage_error),
        (FileNotFoundError("artifact"), Reason.storage_error),
        (CorruptArtifactError("artifact"), Reason.storage_error),
        (CorruptChunkError("chunk"), Reason.storage_error),
        (MemoryError(), Reason.oom_killed),
        (ValueError("x" * 9999), Reason.internal_error),
    ],
)
def test_what_a_stage_raises(error: Exception, reason: Reason) -> None:
    result = failure(error)
    assert (result.outcome, result.reason) == ("failed", reason)
    assert len(result.message) <= MESSAGE_LENGTH


@pytest.mark.parametrize(
    ("error", "renders", "reason"),
    [
        (ray_errors.RayActorError(), True, Reason.renderer_crash),
        (ray_errors.RayActorError(), False, Reason.process_crash),
        (ray_errors.RayActorError(error_msg="The actor died because its node has died."), True, Reason.worker_lost),
        (ray_errors.ActorUnavailableError("connection refused", None), True, Reason.worker_lost),
        (ray_errors.OutOfMemoryError("low on memory"), True, Reason.oom_killed),
        (ray_errors.WorkerCrashedError(), False, Reason.worker_lost),
        (ray_errors.RayTaskError("render", "traceback", OSError(errno.ENOSPC, "full")), True, Reason.store_unavailable),
        (ray_errors.RayTaskError("render", "traceback", "not an exception"), True, Reason.internal_error),
    ],
)
def test_what_ray_raises(error: Exception, renders: bool, reason: Reason) -> None:
    assert process_failure(error, renders=renders).reason is reason
