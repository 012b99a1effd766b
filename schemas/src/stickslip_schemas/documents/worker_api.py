"""Messages between dispatcher and coordinator."""

from typing import Literal

from pydantic import Field, field_validator

from stickslip_schemas.base import Bool, Document, Float, Int, Stage
from stickslip_schemas.documents.tasks import Task, TaskResult
from stickslip_schemas.kinds import KINDS, kind_named
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.costs import MachineSpeed

MAX_SLOTS = 100_000
"""The most tasks that one dispatcher may run at once."""


class WorkerCondition(Document):
    """How a dispatcher is.

    It is `starting` until its Ray cluster answers, and `stopped` after a signal to stop, when its
    silence is no fault.
    """

    state: Literal["starting", "ready", "stopped"] = "ready"
    slots: Int = Field(ge=0, le=MAX_SLOTS, description="number of tasks that run at once")
    reason: str = Field(
        default="", max_length=1000, description="why it is not ready, or what is wrong; for people"
    )
    speed: MachineSpeed = Field(
        default_factory=MachineSpeed, description="scales what jobs cost where nothing was measured"
    )


class WorkerRegistration(Document):
    """Registration of a dispatcher.

    A second one with the same `name` revokes the leases of the first.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$")
    builds: dict[str, Builds] = Field(
        description="builds by kind; none while it looks for them",
        json_schema_extra={"propertyNames": {"enum": list(KINDS)}},
    )
    condition: WorkerCondition
    versions: dict[str, str] = Field(
        default_factory=dict, description="for people: sim_core, blender, ray, ..."
    )

    @field_validator("builds")
    @classmethod
    def _known_kinds(cls, builds: dict[str, Builds]) -> dict[str, Builds]:
        # An unknown kind raises UnknownKindError, which lists the known ones.
        for name in builds:
            kind_named(name)
        return builds


class WorkerSession(Document):
    """Answer to a registration: the id of the worker, and how long a lease lasts unrenewed."""

    worker_id: str
    lease_seconds: float = Field(gt=0)


class LeaseRequest(Document):
    """Ask for at most so many tasks of each stage."""

    worker_id: str
    # A dispatcher may have room for tasks of one stage and not of another.
    wanted: dict[Stage, Int]
    at_most_seconds: Float | None = Field(
        default=None, gt=0, description="exclude tasks that are known to take longer [s]"
    )


class Lease(Document):
    """A task on loan. `token` is its fencing token: a report with an older one is refused."""

    task_id: str
    token: Int
    attempt: Int = Field(ge=1)
    limit_seconds: Float | None = Field(
        default=None,
        gt=0,
        description="timeout of the call [s]; null: no similar task has been measured",
    )
    task: Task


class LeaseBatch(Document):
    """Granted leases, and the delay before the next request if there are none."""

    leases: tuple[Lease, ...]
    retry_after_seconds: float = Field(ge=0)


class LeaseState(Document):
    """A lease that the dispatcher holds, and whether its task has started."""

    task_id: str
    token: Int
    started: Bool
    frames: tuple[Int, Int] | None = Field(
        default=None, description="progress of a simulation: frames done, frames in total"
    )


class Heartbeat(Document):
    """Renew all leases of the dispatcher, and tell how it is."""

    worker_id: str
    leases: tuple[LeaseState, ...] = Field(
        description=(
            "all that it holds: one that is not there is taken back when it has had the "
            "duration of a lease"
        )
    )
    condition: WorkerCondition


class HeartbeatAnswer(Document):
    """Tasks to drop: cancelled by the user, or leased to another worker."""

    drop: tuple[str, ...]


class Report(Document):
    """Result of a leased task, or its return by a dispatcher that stops."""

    task_id: str
    token: Int
    result: TaskResult | None = Field(description="null returns the lease")


class ReportBatch(Document):
    """Reports of several tasks; each has a verdict of its own."""

    worker_id: str
    reports: tuple[Report, ...] = Field(min_length=1)


class ReportVerdict(Document):
    """`accepted`.

    `duplicate` (this very report was accepted before); `stale` (the lease was not the worker's).
    """

    task_id: str
    verdict: Literal["accepted", "duplicate", "stale"]


class ReportAnswer(Document):
    """One verdict for each report, in the same order."""

    verdicts: tuple[ReportVerdict, ...]
