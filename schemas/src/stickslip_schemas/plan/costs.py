"""Numbers of samples and tasks of a spec, and what they cost.

Costs are from tasks that a service has measured or, of other stages, from the records of the
package. These were fitted to measured jobs of 1 to 768 samples on two shared virtual cores. Another
machine, fabric or motion makes them larger or smaller: the 80 % intervals say by how much, and are
guessed.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, prod

from pydantic import Field

from stickslip_schemas.base import Document, Stage
from stickslip_schemas.spec.arrays import SPLITS
from stickslip_schemas.spec.axes import axis_values
from stickslip_schemas.spec.jobs import JobSpec, SeedRule

PACK_SECONDS = 0.03
"""CPU time of packing a sample [s]."""
PUBLISH_SECONDS = 0.1
"""CPU time of publishing a shard [s]."""
UNSURE = 2.0
"""80 % of renders, packs and publishes are taken to be within this factor of their usual time."""


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


def estimated(
    spec: JobSpec, counts: Counts, measured: Mapping[Stage, Interval], slots: int
) -> Estimate:
    """Return what a job costs; `measured` are the CPU times of stages that a service knows [s]."""
    usual = spec.usual_costs
    shaded = usual.start + counts.shadings * usual.shade + counts.render_count * usual.render
    stages = {
        Stage.simulate: _within(counts.simulation_count * usual.simulate, usual.unsure),
        Stage.render: _within(shaded if counts.render_count else 0.0, UNSURE),
        Stage.pack: _within(counts.sample_count * PACK_SECONDS, UNSURE),
        Stage.publish: _within(counts.shards * PUBLISH_SECONDS, UNSURE),
    } | dict(measured)
    totals = {
        name: sum(getattr(stage, name) for stage in stages.values())
        for name in Interval.model_fields
    }
    wall = Interval(**{name: total / slots for name, total in totals.items()}) if slots else None
    return Estimate(
        cpu_seconds=Interval(**totals),
        wall_seconds=wall,
        slots=slots,
        stages=stages,
        measured=tuple(measured),
    )


def _within(seconds: float, unsure: float) -> Interval:
    return Interval(median=seconds, low=seconds / unsure, high=seconds * unsure)
