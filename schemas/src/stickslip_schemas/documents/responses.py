"""What the coordinator answers to users."""

from datetime import datetime
from enum import StrEnum
from typing import Any, Generic, Literal, TypeVar

from pydantic import Field

from stickslip_schemas.base.document import Document, Int
from stickslip_schemas.base.keys import ArtifactRef, Sha256
from stickslip_schemas.base.states import JobState, Reason, Stage, TaskState
from stickslip_schemas.kinds import AnyJobSpec
from stickslip_schemas.plan.builds import Builds

T = TypeVar("T")


class StageProgress(Document):
    """Tasks of one stage. `cached` of the succeeded ones were done before the job came."""

    counts: dict[TaskState, int]
    cached: int
    cpu_seconds: float = Field(description="measured, of the tasks that this job had to run [s]")
    frames: tuple[int, int] | None = Field(
        default=None, description="of the simulations that run and tell: frames done, and frames"
    )

    @property
    def total(self) -> int:
        """Number of tasks."""
        return sum(self.counts.values())

    @property
    def done(self) -> int:
        """Number of tasks that have ended without being cancelled."""
        return sum(count for state, count in self.counts.items() if state.is_over and state is not TaskState.cancelled)


class Eta(Document):
    """Time that is left, from measured durations; `low` to `high` covers about 80 % of jobs [s]."""

    seconds: float
    low: float
    high: float


class Progress(Document):
    """How far a job is."""

    done: int = Field(description="tasks that are over, of all stages")
    total: int
    planned: int = Field(
        description="samples whose tasks are written down; `done` and `total` count the tasks of these only"
    )
    stages: dict[Stage, StageProgress]
    eta: Eta | None = Field(description="null until there is a measurement to go by, and when nothing is left")


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
    project: str = Field(description="of the key that it was submitted with; empty: of none")
    priority: int = Field(description="of the tasks of a project, those of the job with the highest number come first")
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
    """What a job would be, without making one. `refusal` says why it would be refused now; null: it would not."""

    spec: AnyJobSpec
    spec_digest: Sha256
    sample_count: int
    simulation_count: int = Field(description="different simulations; samples that differ in their look share one")
    render_count: int
    task_count: int = Field(description="tasks of all stages: simulations, renders, shards, and one that publishes")
    expected_splits: dict[str, int] = Field(
        description="samples by split if each got exactly its share; the real numbers differ a little"
    )
    cached_count: int | None = Field(
        description="tasks that have a result already; null: no worker has registered, or the grid is too large to look"
    )
    bytes_estimate: int = Field(description="size of the arrays before compression [bytes]")
    stored_bytes_estimate: int | None = Field(
        description="size of the files, compressed as the newest dataset of the kind was [bytes]; null: there is none"
    )
    certificate: Sha256 | None = Field(description="of the certificate that will vouch for the dataset; null: none")
    refusal: str | None = Field(description="why a job of this spec would be refused now; null: it would be accepted")


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
    """A picture that the coordinator has taken as a texture."""

    texture: ArtifactRef = Field(description="what a spec writes under `textures`")
    side: int = Field(description="width and height [px]")
    bytes: int


class CertificateEntry(Document):
    """A certificate that the coordinator has."""

    digest: Sha256
    preset: str
    sim_core: Sha256 = Field(description="build of sim_core that was measured")
    extent: Literal["full", "quick"]
    passed: bool
    created_at: datetime
    href: str
    page: str = Field(description="where the page for people is")


class SampleState(Document):
    """A sample of a job and how far it is; `labels` are its point of the grid."""

    slot: int
    sample_key: Sha256
    split: int
    labels: dict[str, Any]
    state: TaskState
    reason: Reason | None
    message: str


class JobPatch(Document):
    """What can be changed of a job."""

    priority: Int = Field(ge=-100, le=100, description="tasks of the job with the highest number come first")


class RunningTask(Document):
    """A task that a worker holds."""

    task_id: str
    stage: Stage
    job: str | None
    since: datetime | None = Field(description="when it was started; null: it waits at the worker")
    frames: tuple[int, int] | None = Field(description="of a simulation that tells: frames done, and frames")


class WorkerEntry(Document):
    """A dispatcher that has registered."""

    id: str
    name: str
    slots: int
    builds: dict[str, Builds] = Field(description="of each kind that it makes")
    versions: dict[str, str]
    registered_at: datetime
    last_seen_at: datetime
    alive: bool = Field(description="it was heard of within the time that a lease lasts")
    leased: int = Field(description="tasks that it holds")
    running: tuple[RunningTask, ...] = Field(description="of these, the ones that have been started, the oldest first")


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
