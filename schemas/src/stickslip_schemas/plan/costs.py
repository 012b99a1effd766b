"""What a job costs: from tasks that a service has measured or, of other stages, from the records of the package.

The usual costs of a kind were fitted to measured jobs of 1 to 768 samples on two shared virtual cores. Another machine,
fabric or motion makes them larger or smaller: the 80 % intervals say by how much, and are guessed.
"""

from collections.abc import Mapping

from pydantic import Field

from stickslip_schemas.base import Document, Stage
from stickslip_schemas.plan.grid import Counts
from stickslip_schemas.spec.jobs import JobSpec

PACK_SECONDS = 0.03
"""CPU time of packing a sample [s]."""
PUBLISH_SECONDS = 0.1
"""CPU time of publishing a shard [s]."""
UNSURE = 2.0
"""80 % of renders, packs and publishes are taken to be within this factor of their usual time."""


class Interval(Document):
    """A time [s]; 80 % of jobs lie from `low` to `high`."""

    median: float
    low: float
    high: float


class Estimate(Document):
    """What a job costs without cached results."""

    cpu_seconds: Interval
    wall_seconds: Interval | None = Field(
        description="on the slots of the workers that are there, a core each; null: none is there"
    )
    slots: int = Field(description="tasks that can run at once")
    stages: dict[Stage, Interval] = Field(description="CPU time by stage [s]")
    measured: tuple[Stage, ...] = Field(description="stages whose cost this service has measured")


def estimated(spec: JobSpec, counts: Counts, measured: Mapping[Stage, Interval], slots: int) -> Estimate:
    """Return what a job costs; `measured` are the CPU times of stages that a service knows [s]."""
    usual = spec.usual_costs
    shaded = (
        0.0
        if not counts.render_count
        else usual.start + counts.shadings * usual.shade + counts.render_count * usual.render
    )
    stages = {
        Stage.simulate: _within(counts.simulation_count * usual.simulate, usual.unsure),
        Stage.render: _within(shaded, UNSURE),
        Stage.pack: _within(counts.sample_count * PACK_SECONDS, UNSURE),
        Stage.publish: _within(counts.shards * PUBLISH_SECONDS, UNSURE),
    } | dict(measured)
    totals = {name: sum(getattr(stage, name) for stage in stages.values()) for name in Interval.model_fields}
    wall = Interval(**{name: total / slots for name, total in totals.items()}) if slots else None
    return Estimate(
        cpu_seconds=Interval(**totals), wall_seconds=wall, slots=slots, stages=stages, measured=tuple(measured)
    )


def _within(seconds: float, unsure: float) -> Interval:
    return Interval(median=seconds, low=seconds / unsure, high=seconds * unsure)
