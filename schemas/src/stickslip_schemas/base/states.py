"""States of jobs and tasks, and the reason codes of every ending."""

from enum import StrEnum


class JobState(StrEnum):
    """Where a job is; `pausing` and `cancelling` last until the leased tasks have been given back.

    A job of many samples is `planning` until all its tasks are written down; the first of them run meanwhile.
    """

    planning = "planning"
    queued = "queued"
    running = "running"
    pausing = "pausing"
    paused = "paused"
    cancelling = "cancelling"
    cancelled = "cancelled"
    succeeded = "succeeded"
    succeeded_with_rejects = "succeeded_with_rejects"
    failed = "failed"

    @property
    def is_open(self) -> bool:
        """True until the job has ended."""
        ended = (JobState.cancelled, JobState.succeeded, JobState.succeeded_with_rejects, JobState.failed)
        return self not in ended


class TaskState(StrEnum):
    """Where a task is; `soft_failed` waits for another try, `rejected` is a result, not a fault."""

    pending = "pending"
    leased = "leased"
    running = "running"
    succeeded = "succeeded"
    soft_failed = "soft_failed"
    failed = "failed"
    rejected = "rejected"
    cancelled = "cancelled"

    @property
    def is_settled(self) -> bool:
        """True where the task has a result that others may use."""
        return self in (TaskState.succeeded, TaskState.rejected)

    @property
    def is_over(self) -> bool:
        return self.is_settled or self in (TaskState.failed, TaskState.cancelled)


class Stage(StrEnum):
    """Steps of the pipeline, in order."""

    simulate = "simulate"
    render = "render"
    pack = "pack"
    publish = "publish"


class Reason(StrEnum):
    """Why a job or task ended, or why it waits."""

    # Infrastructure: another try may succeed.
    exec_timeout = "exec_timeout"
    worker_lost = "worker_lost"
    oom_killed = "oom_killed"
    renderer_crash = "renderer_crash"
    process_crash = "process_crash"
    storage_error = "storage_error"
    store_unavailable = "store_unavailable"
    internal_error = "internal_error"
    # The sample itself: deterministic, never retried.
    solver_diverged = "solver_diverged"
    out_of_frame = "out_of_frame"
    invalid_sample = "invalid_sample"
    poor_pictures = "poor_pictures"
    # The same, of cloth: the check of the solver that failed.
    not_finite = "not_finite"
    jumps = "jumps"
    unconverged = "unconverged"
    budget = "budget"
    missed = "missed"
    crossings = "crossings"
    contact_gain = "contact_gain"
    stretch = "stretch"
    penetration = "penetration"
    passages = "passages"
    sharpness = "sharpness"
    # A job's own.
    cancelled = "cancelled"
    failed_tasks = "failed_tasks"
    quarantined = "quarantined"
    waiting_for_worker = "waiting_for_worker"
    preset_not_certified = "preset_not_certified"

    @property
    def ends_a_process(self) -> bool:
        """True where a task took its process with it; one that does so again and again is quarantined."""
        return self in _ENDING

    @property
    def is_deterministic(self) -> bool:
        """True where a second try gives the same answer, so that the sample is rejected and not retried."""
        return self not in _INFRASTRUCTURE | _OF_JOBS


_ENDING = {Reason.exec_timeout, Reason.worker_lost, Reason.oom_killed, Reason.renderer_crash, Reason.process_crash}
_INFRASTRUCTURE = {*_ENDING, Reason.storage_error, Reason.store_unavailable, Reason.internal_error}
_OF_JOBS = {
    Reason.cancelled,
    Reason.failed_tasks,
    Reason.quarantined,
    Reason.waiting_for_worker,
    Reason.preset_not_certified,
}
