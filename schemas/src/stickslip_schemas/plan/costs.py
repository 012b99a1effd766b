"""Numbers of samples and tasks of a spec, and the cost of a job.

Costs are from tasks that a service has measured or, of other stages, from the records of the
package. These were fitted to measured jobs of 1 to 2,500 samples (benchmarks/job_costs.py), and are
CPU seconds of the machine that `stickslip_workers.machine` measures others against. Another fabric
or motion makes them larger or smaller: the 80 % intervals say by how much.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, prod

from pydantic import Field

from stickslip_schemas.base import Document, Float, Stage
from stickslip_schemas.spec.arrays import SPLITS
from stickslip_schemas.spec.axes import axis_values
from stickslip_schemas.spec.jobs import JobSpec, SeedRule

PUBLISH_SECONDS = 0.3
"""CPU time of publishing a version [s]."""

PUBLISH_SHARD_SECONDS = 0.02
"""CPU time of a shard in a version that is published [s]."""

JOB_SECONDS = 2.0
"""Wall time of a job beside its tasks [s]: leases, and waits of one stage for another."""

UNCERTAINTY_FACTOR = 1.6
"""80 % of renders, packs and publishes take within this factor of their usual time."""


@dataclass(frozen=True, slots=True)
class Counts:
    """Numbers of samples and tasks of a spec."""

    sample_count: int
    simulation_count: int
    render_count: int
    shadings: int
    """Renders that differ in more than the axis of variants."""
    shards: int
    expected_splits: dict[str, int]
    """Samples by split if each split got exactly its share; splits are drawn, so real numbers
    differ a little.
    """

    @property
    def task_count(self) -> int:
        return self.simulation_count + self.render_count + self.shards + 1


def count(spec: JobSpec) -> Counts:
    """Return the numbers of `spec`.

    Two samples share a simulation where they agree in all axes that enter its document or its
    seeds, and a render where they agree in those of the render, too. Time and memory grow with the
    longest axis, not with the grid.
    """
    physical = _axes_of(spec, spec.simulation_type, spec.simulation_seeds)
    seen = physical | _axes_of(spec, spec.render_type, spec.render_seeds)
    bounds = [0.0, spec.splits.train, spec.splits.train + spec.splits.validation, 1.0]
    ends = [round(bound * spec.sample_count) for bound in bounds]
    return Counts(
        sample_count=spec.sample_count,
        simulation_count=_distinct(spec, physical),
        render_count=0 if spec.render_settings() is None else _distinct(spec, seen),
        shadings=0
        if spec.render_settings() is None
        else _distinct(spec, seen - {spec.variant_axis}),
        shards=ceil(spec.sample_count / spec.samples_per_shard),
        expected_splits={
            name: stop - start for name, (start, stop) in zip(SPLITS, pairwise(ends), strict=True)
        },
    )


def _axes_of(spec: JobSpec, document: type[Document], seeds: Collection[SeedRule]) -> set[str]:
    """Return the axes that a document of a sample depends on."""
    entering = {axis for rule in seeds for axis in spec.seed_axes(rule)}
    fields = document.model_fields
    return entering | {
        a
        for a in spec.named_axes
        if any(path.partition("/")[0] in fields for path in spec.fields_of(a))
    }


def _distinct(spec: JobSpec, names: Collection[str]) -> int:
    """Return how many different values some axes take together over the grid."""
    axes = [
        (place, axis) for place, (name, axis) in enumerate(spec.named_axes.items()) if name in names
    ]
    # A narrow range holds fewer numbers than it may be asked for, and zipped lists may repeat
    # values.
    if spec.combine == "product":
        return prod(len(set(axis_values(axis))) for _, axis in axes)
    import numpy as np  # the extra `arrays`

    rows = np.zeros(spec.sample_count, dtype=np.int64)
    for place, axis in axes:
        values = axis_values(axis, dimension=place)
        codes = {value: code for code, value in enumerate(dict.fromkeys(values))}
        if (
            len(codes) == spec.sample_count
        ):  # zipped axes have one length: this one tells all samples apart
            return spec.sample_count
        _, rows = np.unique(
            rows * len(codes) + [codes[value] for value in values], return_inverse=True
        )
    return int(rows.max()) + 1


class MachineSpeed(Document):
    """How fast the CPUs of a machine are, beside the machine of the packaged costs."""

    cpu_speed: Float = Field(
        default=1.0, gt=0, description="CPU time there over CPU time here, of the same work"
    )
    cpu_available: Float = Field(
        default=1.0, gt=0, le=1, description="CPUs that a busy process gets: less under a quota"
    )


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


def estimate_cost(
    spec: JobSpec,
    counts: Counts,
    measured: Mapping[Stage, Interval],
    slots: int,
    speed: MachineSpeed | None = None,
) -> Estimate:
    """Return the cost of a job, without cached results.

    `measured` are the CPU times of stages that a service knows [s]; packaged costs stand for the
    others, and `speed` carries them over to the machine of the workers. With c_s the CPU time of
    stage s, n_s its tasks, p slots and a the CPUs that each slot gets,

        T = sum_s c_s / (a min(n_s, p)) + JOB_SECONDS
    """
    speed = speed or MachineSpeed()
    stages = _packaged_costs(spec, counts, speed, max(slots, 1)) | dict(measured)
    totals = {}
    for name in Interval.model_fields:
        totals[name] = sum(getattr(stage, name) for stage in stages.values())
    return Estimate(
        cpu_seconds=Interval(**totals),
        wall_seconds=_wall_time(stages, counts, slots, speed) if slots else None,
        slots=slots,
        stages=stages,
        measured=tuple(measured),
    )


def _packaged_costs(
    spec: JobSpec, counts: Counts, speed: MachineSpeed, slots: int
) -> dict[Stage, Interval]:
    """Return the CPU times of the stages by the records of the package [s]."""
    costs = spec.default_costs
    # A process that starts has to import the solver or Blender: each slot does so once.
    simulating = min(slots, counts.simulation_count)
    rendering = min(slots, counts.shadings)
    simulate = simulating * costs.simulator_start + counts.simulation_count * costs.simulate
    render = 0.0
    if counts.render_count:
        render = rendering * costs.renderer_start
        render += counts.shadings * costs.shade + counts.render_count * costs.render
    publish = PUBLISH_SECONDS + counts.shards * PUBLISH_SHARD_SECONDS
    seconds = {
        Stage.simulate: (simulate, costs.uncertainty_factor),
        Stage.render: (render, UNCERTAINTY_FACTOR),
        Stage.pack: (counts.sample_count * costs.pack, UNCERTAINTY_FACTOR),
        Stage.publish: (publish, UNCERTAINTY_FACTOR),
    }
    stages = {}
    for stage, (reference_seconds, factor) in seconds.items():
        median = reference_seconds / speed.cpu_speed
        stages[stage] = Interval(median=median, low=median / factor, high=median * factor)
    return stages


def _wall_time(
    stages: Mapping[Stage, Interval], counts: Counts, slots: int, speed: MachineSpeed
) -> Interval:
    """Return the wall time of stages that run one after the other [s]."""
    tasks = {
        Stage.simulate: counts.simulation_count,
        Stage.render: counts.shadings,  # renders of one shading are one call
        Stage.pack: counts.shards,
        Stage.publish: 1,
    }
    walls = {}
    for name in Interval.model_fields:
        seconds = JOB_SECONDS
        for stage, interval in stages.items():
            parallel = max(1, min(slots, tasks[stage]))
            seconds += getattr(interval, name) / (parallel * speed.cpu_available)
        walls[name] = seconds
    return Interval(**walls)
