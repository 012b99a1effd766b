"""Answers and events of the coordinator for users."""

from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import Field

from stickslip_schemas.base import (
    ArtifactRef,
    Document,
    Int,
    JobState,
    Reason,
    Sha256,
    Stage,
    TaskState,
)
from stickslip_schemas.documents.worker_api import WorkerCondition
from stickslip_schemas.kinds import AnyJobSpec
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.costs import Estimate

T = TypeVar("T")


class StageProgress(Document):
    """Tasks of one stage. `cached` of the succeeded ones were done before the job came."""

    counts: dict[TaskState, int]
    cached: int
    cpu_seconds: float = Field(description="CPU time of the tasks that this job ran [s]")
    frames: tuple[int, int] | None = Field(
        default=None,
        description="progress of the running simulations: frames done, frames in total",
    )

    @property
    def total(self) -> int:
        return sum(self.counts.values())

    @property
    def done(self) -> int:
        """Number of tasks that have a result: those that failed or were cancelled have none."""
        return sum(count for state, count in self.counts.items() if state.is_settled)


class Eta(Document):
    """Estimated time, from measured durations; `low` to `high` covers about 80 % of jobs [s]."""

    seconds: float
    low: float
    high: float


class Progress(Document):
    """Progress of a job."""

    done: int = Field(description="tasks of all stages that have a result")
    total: int
    planned: int = Field(description="planned samples; `done` and `total` count only their tasks")
    stages: dict[Stage, StageProgress]
    eta: Eta | None = Field(
        description=(
            "null before the first measurement, when nothing remains, and in the answer to a "
            "submission"
        )
    )


class DatasetRef(Document):
    """A dataset version."""

    dataset: str
    version: int
    manifest: Sha256


class Job(Document):
    """A job."""

    id: str
    name: str | None
    kind: str
    state: JobState
    reason: Reason | None
    message: str
    project: str = Field(description="project of the key that submitted it; empty: none")
    priority: int = Field(
        description="within a project, tasks of the job with the highest number run first"
    )
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    sample_count: int
    rejected_count: int
    progress: Progress
    dataset: DatasetRef | None


class JobDetail(Job):
    """A job with its spec."""

    spec: AnyJobSpec


class Validation(Document):
    """Size and cost of a job that is not submitted."""

    # Counts first, then sizes and times, then whether it would be accepted.
    spec: AnyJobSpec
    spec_digest: Sha256
    sample_count: int
    simulation_count: int = Field(
        description="different simulations; samples that differ in their look share one"
    )
    render_count: int
    task_count: int = Field(
        description="tasks of all stages: simulations, renders, shards, and one that publishes"
    )
    expected_splits: dict[str, int] = Field(
        description=(
            "expected samples by split; splits are drawn, so the numbers of a dataset "
            "differ slightly"
        )
    )
    cached_count: int | None = Field(
        description=(
            "tasks with a cached result; null: no worker has registered, or the grid is "
            "too large to search"
        )
    )
    bytes_estimate: int = Field(description="size of the arrays before compression [bytes]")
    stored_bytes_estimate: int | None = Field(
        description=(
            "file size, compressed as the newest dataset of the kind [bytes]; null: there is none"
        )
    )
    estimate: Estimate = Field(
        description=(
            "time of all tasks, without cached results, from what this service or the "
            "package has measured"
        )
    )
    certificate: Sha256 | None = Field(
        description="certificate that covers the dataset; null: none"
    )
    refusal: str | None = Field(
        description="reason why a job of this spec would be refused now; null: it would be accepted"
    )


class Dataset(Document):
    """A dataset: every version answers the same spec."""

    id: str
    name: str | None
    kind: str
    spec_digest: Sha256
    versions: tuple["DatasetVersion", ...]


class DatasetVersion(Document):
    """A committed version."""

    version: int
    manifest: Sha256
    group: Sha256 = Field(description="of the root's zarr.json, which names the manifest")
    created_at: datetime
    sample_count: int
    valid_count: int
    bytes: int


class TextureEntry(Document):
    """An uploaded texture."""

    texture: ArtifactRef = Field(description="reference for `textures` in a spec")
    side: int = Field(description="width and height [px]")
    bytes: int


class FileUpload(Document):
    """An uploaded file of a scene."""

    file: ArtifactRef = Field(description="reference for the document of a scene")
    counts: Annotated[tuple[int, ...], Field(min_length=2, max_length=2)] | None = Field(
        description="vertices and triangles of a mesh file: `counts` of a mesh"
    )
    bytes: int


class CertificateEntry(Document):
    """A certificate on the coordinator."""

    digest: Sha256
    preset: str
    sim_core: Sha256 = Field(description="measured build of sim_core")
    extent: Literal["full", "quick"]
    passed: bool
    created_at: datetime
    href: str


class SampleState(Document):
    """State of a sample of a job; `labels` are its point of the grid."""

    slot: int
    sample_key: Sha256
    split: int
    labels: dict[str, Any]
    state: TaskState
    reason: Reason | None
    message: str


class JobPatch(Document):
    """Changes to a job."""

    priority: Int = Field(
        ge=-100, le=100, description="tasks of the job with the highest number run first"
    )


class RunningTask(Document):
    """A task that a worker holds."""

    task_id: str
    stage: Stage
    job: str | None
    since: datetime | None = Field(description="start time; null while it waits at the worker")
    frames: tuple[int, int] | None = Field(
        description="progress of a simulation: frames done, frames in total"
    )


class WorkerEntry(Document):
    """A dispatcher that has registered."""

    id: str
    name: str
    condition: WorkerCondition
    builds: dict[str, Builds] = Field(description="builds by kind")
    versions: dict[str, str]
    registered_at: datetime
    last_seen_at: datetime
    alive: bool = Field(description="its last heartbeat is no older than a lease")
    leased: int = Field(description="number of leased tasks")
    running: tuple[RunningTask, ...] = Field(description="started tasks, oldest first")


class Preview(Document):
    """A picture of one sample."""

    slot: int
    labels: dict[str, Any]
    href: str


class Page(Document, Generic[T]):
    """One page of a list, newest first; `next_page_token` is null on the last one."""

    items: tuple[T, ...]
    next_page_token: str | None


class EventName(StrEnum):
    """The `event:` field."""

    job_state = "job.state"
    job_progress = "job.progress"
    task_state = "task.state"
    dataset_published = "dataset.published"


class JobStateEvent(Document):
    """The job changed its state. A terminal state is the last event."""

    state: JobState
    reason: Reason | None
    message: str

    def __str__(self) -> str:
        """Return one line: `failed: no sample is valid`."""
        return f"{self.state}: {self.message}" if self.message else str(self.state)


class JobProgressEvent(Document):
    """Tasks have ended."""

    progress: Progress

    def __str__(self) -> str:
        """Return one line: `12 of 40 tasks: simulate 4/4, render 8/36`."""
        stages = [
            f"{stage} {counts.done}/{counts.total}"
            for stage, counts in self.progress.stages.items()
            if counts.total
        ]
        return f"{self.progress.done} of {self.progress.total} tasks: {', '.join(stages)}"


class TaskStateEvent(Document):
    """A task was soft_failed, failed or rejected."""

    task_id: str
    stage: Stage
    state: TaskState
    reason: Reason
    message: str

    def __str__(self) -> str:
        """Return one line: `render rejected: out_of_frame: the rod leaves the frame`."""
        return f"{self.stage} {self.state}: {self.reason}: {self.message}"


class DatasetPublishedEvent(Document):
    """A dataset version was committed."""

    dataset: DatasetRef

    def __str__(self) -> str:
        """Return one line: `published ds-0123456789abcdef:v1`."""
        return f"published {self.dataset.dataset}:v{self.dataset.version}"
