"""What a dispatcher and the coordinator say to each other."""

from typing import Literal

from pydantic import Field, field_validator

from stickslip_schemas.base.document import Bool, Document, Float, Int
from stickslip_schemas.base.states import Stage
from stickslip_schemas.documents.tasks import Task, TaskResult
from stickslip_schemas.kinds import KINDS, kind_named
from stickslip_schemas.plan.builds import Builds

MAX_SLOTS = 100_000
"""The most tasks that one dispatcher may run at once."""


class WorkerRegistration(Document):
    """A dispatcher presents itself. A second registration of a `name` takes the first one's leases away."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$")
    builds: dict[str, Builds] = Field(
        min_length=1,
        description="of each kind that it makes",
        json_schema_extra={"propertyNames": {"enum": list(KINDS)}},
    )
    slots: Int = Field(ge=1, le=MAX_SLOTS, description="how many tasks it runs at once")
    versions: dict[str, str] = Field(default_factory=dict, description="for people: sim_core, blender, ray, ...")

    @field_validator("builds")
    @classmethod
    def _known_kinds(cls, builds: dict[str, Builds]) -> dict[str, Builds]:
        for name in builds:
            kind_named(name)
        return builds


class WorkerSession(Document):
    """The coordinator's answer: who the dispatcher is, and how long a lease lasts without a heartbeat."""

    worker_id: str
    lease_seconds: float = Field(gt=0)


class LeaseRequest(Document):
    """Ask for at most so many tasks of each stage."""

    worker_id: str
    wanted: dict[Stage, Int]
    at_most_seconds: Float | None = Field(
        default=None, gt=0, description="leave out tasks of which it is known that they take longer [s]"
    )


class Lease(Document):
    """A task on loan. `token` is its fencing token: a report with an older one is refused."""

    task_id: str
    token: Int
    attempt: Int = Field(ge=1)
    limit_seconds: Float | None = Field(
        default=None, gt=0, description="end the call after this time; null: nothing like it has been measured [s]"
    )
    traceparent: str | None = Field(
        default=None,
        description="W3C traceparent of the job's submission; null where no spans are exported",
    )
    task: Task


class LeaseBatch(Document):
    """What was granted, and when it makes sense to ask again if it is nothing."""

    leases: tuple[Lease, ...]
    retry_after_seconds: float = Field(ge=0)


class LeaseState(Document):
    """A lease that the dispatcher believes to hold, and whether the task has been started."""

    task_id: str
    token: Int
    started: Bool
    frames: tuple[Int, Int] | None = Field(default=None, description="of a simulation: frames done, and frames")


class Heartbeat(Document):
    """Renew the leases."""

    worker_id: str
    leases: tuple[LeaseState, ...]


class HeartbeatAnswer(Document):
    """Which of the tasks to drop: cancelled by the user, or no longer the dispatcher's."""

    drop: tuple[str, ...]


class Report(Document):
    """How one leased task ended; `released` gives it back untouched (a dispatcher that stops)."""

    task_id: str
    token: Int
    result: TaskResult | None = Field(description="null gives the lease back")


class ReportBatch(Document):
    """Reports of several tasks; each is judged by itself."""

    worker_id: str
    reports: tuple[Report, ...] = Field(min_length=1)


class ReportVerdict(Document):
    """`accepted`; `duplicate` (this very report was accepted before); `stale` (the lease was not the worker's)."""

    task_id: str
    verdict: Literal["accepted", "duplicate", "stale"]


class ReportAnswer(Document):
    """One verdict a report, in their order."""

    verdicts: tuple[ReportVerdict, ...]
