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

PUBLISH_SECONDS = 0.2
"""CPU time of publishing a version [s]."""

PUBLISH_SHARD_SECONDS = 0.002
"""CPU time of a shard in a version that is published [s]."""

JOB_SECONDS = 2.0
"""Wall time of a job beside its tasks [s]: leases, and waits of one stage for another."""

UNCERTAINTY_FACTOR = 1.6
"""80 % of packs and publishes take within this factor of their usual time."""


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
    """Samples by split if each split got exactly its fraction.

    Splits are drawn, so real numbers differ a little.
    """

    @property
    def task_count(self) -> int:
        return self.simulation_count + self.render_count + self.shards + 1


def count(spec: JobSpec) -> Counts:
    """Return the numbers of `spec`.

    Two samples share a simulation if they agree in all axes that enter its document or its
    seeds, and a render if they also agree in the axes of the render. Time and memory grow with the
    longest axis, not with the grid.
    """
    simulation_axes = _entering_axes(spec, spec.simulation_type, spec.simulation_seeds)
    render_axes = simulation_axes | _entering_axes(spec, spec.render_type, spec.render_seeds)

    render_count = 0
    shadings = 0
    if spec.render_settings() is not None:
        render_count = _distinct_points(spec, render_axes)
        # Renders that differ only in the variant, such as the texture, share a shading.
        shadings = _distinct_points(spec, render_axes - {spec.variant_axis})

    return Counts(
        sample_count=spec.sample_count,
        simulation_count=_distinct_points(spec, simulation_axes),
        render_count=render_count,
        shadings=shadings,
        shards=ceil(spec.sample_count / spec.samples_per_shard),
        expected_splits=_expected_splits(spec),
    )


def _expected_splits(spec: JobSpec) -> dict[str, int]:
    """Return the number of samples of each split if each got exactly its fraction."""
    bounds = [0.0, spec.splits.train, spec.splits.train + spec.splits.validation, 1.0]
    # The bounds are rounded, not the sizes: so the sizes add up to the number of samples.
    slots = [round(bound * spec.sample_count) for bound in bounds]
    return {name: stop - start for name, (start, stop) in zip(SPLITS, pairwise(slots), strict=True)}


def _entering_axes(
    spec: JobSpec, document: type[Document], seeds: Collection[SeedRule]
) -> set[str | None]:
    """Return the axes that a document of a sample depends on, by its fields or by its seeds."""
    axes: set[str | None] = set()
    for rule in seeds:
        axes.update(spec.seed_axes(rule))
    for axis in spec.named_axes:
        # A path "field/inner/..." sets a value inside of a field.
        field_names = {path.partition("/")[0] for path in spec.fields_of(axis)}
        if not field_names.isdisjoint(document.model_fields):
            axes.add(axis)
    return axes


def _distinct_points(spec: JobSpec, names: Collection[str | None]) -> int:
    """Return how many different values some axes take together over the grid."""
    axes = [
        (dimension, axis)
        for dimension, (name, axis) in enumerate(spec.named_axes.items())
        if name in names
    ]
    # Values are counted, not taken from `num`: a narrow range holds fewer different numbers than
    # it may be asked for, and zipped lists may repeat values.
    if spec.combine == "product":
        return prod(len(set(axis_values(axis))) for _, axis in axes)

    import numpy as np  # the extra `arrays`

    # Number the rows of the zipped columns: after each axis, two samples have the same number if
    # they agree in all axes so far.
    row_codes = np.zeros(spec.sample_count, dtype=np.int64)
    for dimension, axis in axes:
        values = axis_values(axis, dimension=dimension)
        codes = {value: code for code, value in enumerate(dict.fromkeys(values))}
        # Zipped axes have one length, so this axis alone tells all samples apart.
        if len(codes) == spec.sample_count:
            return spec.sample_count
        column = [codes[value] for value in values]
        _, row_codes = np.unique(row_codes * len(codes) + column, return_inverse=True)
    return int(row_codes.max()) + 1


class MachineSpeed(Document):
    """How fast the CPUs of a machine are, beside the machine of the packaged costs."""

    cpu_speed: Float = Field(
        default=1.0, gt=0, description="CPU time there over CPU time here, of the same work"
    )
    cpu_available: Float = Field(
        default=1.0, gt=0, le=1, description="CPUs that a process gets while all slots are busy"
    )
    cpu_alone: Float = Field(
        default=1.0, gt=0, le=1, description="CPUs that a process gets while no other one is busy"
    )


class Interval(Document):
    """A time [s]; 80 % of jobs lie from `low` to `high`."""

    median: float
    low: float
    high: float


class Estimate(Document):
    """Cost of a job without cached results."""

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
    stage s, n_s its tasks, p slots, a the CPUs that each busy slot gets and b those of a slot that
    is busy alone,

        T = sum_s c_s / min(b n_s, a p) + JOB_SECONDS
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
        Stage.render: (render, costs.render_factor),
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
            # Few tasks share what all slots have together.
            available = speed.cpu_available * slots
            cpus = min(max(1, tasks[stage]) * max(speed.cpu_alone, speed.cpu_available), available)
            seconds += getattr(interval, name) / cpus
        walls[name] = seconds
    return Interval(**walls)
