"""What a plan is: the tasks and samples of a job, or of a piece of it, and what it is made with."""

from dataclasses import dataclass, field
from typing import NamedTuple

from stickslip_schemas.base.keys import Sha256
from stickslip_schemas.base.states import Stage
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.jobs import JobSpec


@dataclass(frozen=True, slots=True)
class Terms:
    """What a job is made with: the builds of the workers, and the certificate that vouches for them, if any does."""

    builds: Builds
    certificate: Sha256 | None


class PlannedTask(NamedTuple):
    """A task as a job needs it."""

    stage: str  # a plain str: sqlite3 binds it three times as fast as a member of Stage
    build: str
    payload: str
    depends_on: tuple[bytes, ...] = ()
    preview: bool = False
    cost_group: str = ""


class PlannedSample(NamedTuple):
    """A slot of the dataset."""

    slot: int
    key: bytes
    simulate_task: bytes
    render_task: bytes | None
    split: int
    labels: str


@dataclass(slots=True)
class Plan:
    """Tasks of a job by content key, in the order in which they should run, and samples: all, or those of a piece."""

    spec: JobSpec
    first: int
    """The first slot."""
    tasks: dict[bytes, PlannedTask] = field(default_factory=dict)
    samples: list[PlannedSample] = field(default_factory=list)

    @property
    def end(self) -> int:
        """The slot after the last one."""
        return self.first + len(self.samples)

    @property
    def is_last(self) -> bool:
        """True where it ends with the task that publishes."""
        return self.end == self.spec.sample_count

    @property
    def publish_key(self) -> bytes:
        """Key of the last task, of the last piece."""
        return next(reversed(self.tasks))

    @property
    def simulation_count(self) -> int:
        """Number of different simulations."""
        return sum(task.stage == Stage.simulate.value for task in self.tasks.values())
