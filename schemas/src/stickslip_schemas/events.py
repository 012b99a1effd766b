"""Events of a job, as its event stream sends them (server-sent events with increasing ids)."""

from enum import StrEnum

from stickslip_schemas.base import Document
from stickslip_schemas.responses import DatasetRef, Progress
from stickslip_schemas.states import JobState, Reason, Stage, TaskState


class EventName(StrEnum):
    """The `event:` field."""

    job_state = "job.state"
    job_progress = "job.progress"
    task_state = "task.state"
    dataset_published = "dataset.published"


class JobStateEvent(Document):
    """The job is in another state. It is the last event where the state is terminal."""

    state: JobState
    reason: Reason | None
    message: str


class JobProgressEvent(Document):
    """Tasks have ended."""

    progress: Progress


class TaskStateEvent(Document):
    """A task came to an end worth telling: soft_failed, failed or rejected."""

    task_id: str
    stage: Stage
    state: TaskState
    reason: Reason
    message: str


class DatasetPublishedEvent(Document):
    """A dataset version was committed."""

    dataset: DatasetRef
