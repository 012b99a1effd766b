"""The points of a parameter grid, and the numbers of samples and tasks without walking it."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import ceil, prod
from typing import Any

from stickslip_schemas.base import Document
from stickslip_schemas.spec.arrays import SPLITS
from stickslip_schemas.spec.axes import axis_values
from stickslip_schemas.spec.jobs import JobSpec, SeedRule


def dataset_id(spec: JobSpec) -> str:
    """Return the id of the dataset that answers `spec`: the same spec has the same dataset, in any build."""
    return f"ds-{spec.content_digest[:16]}"


def grid(spec: JobSpec) -> Iterator[dict[str, Any]]:
    """Yield the point of the parameter grid of each sample, in the order of the slots."""
    names = tuple(spec.named_axes)
    for point in combined(spec, columns_of(spec)):
        yield dict(zip(names, point, strict=True))


def columns_of(spec: JobSpec) -> list[list[Any]]:
    """Return the values of each axis, in order."""
    zipped = spec.combine == "zip"
    axes = spec.named_axes.values()
    return [axis_values(axis, dimension=position if zipped else 0) for position, axis in enumerate(axes)]


def combined(spec: JobSpec, columns: Sequence[Iterable[Any]]) -> Iterator[tuple[Any, ...]]:
    """Combine one column of cells for each axis as the spec says: all with all, or row by row."""
    return zip(*columns, strict=True) if spec.combine == "zip" else product(*columns)


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
    """Samples by split if each split got exactly its share; splits are drawn, so real numbers differ a little."""

    @property
    def task_count(self) -> int:
        return self.simulation_count + self.render_count + self.shards + 1


def count(spec: JobSpec) -> Counts:
    """Return the numbers of `spec`.

    Two samples share a simulation where they agree in all axes that enter its document or its seeds, and a render where
    they agree in those of the render, too. Time and memory grow with the longest axis, not with the grid.
    """
    physical = _axes_of(spec, spec.simulation_type, spec.simulation_seeds)
    seen = physical | _axes_of(spec, spec.render_type, spec.render_seeds)
    bounds = [0.0, spec.splits.train, spec.splits.train + spec.splits.validation, 1.0]
    ends = [round(bound * spec.sample_count) for bound in bounds]
    return Counts(
        sample_count=spec.sample_count,
        simulation_count=_distinct(spec, physical),
        render_count=0 if spec.render_settings() is None else _distinct(spec, seen),
        shadings=0 if spec.render_settings() is None else _distinct(spec, seen - {spec.variant_axis}),
        shards=ceil(spec.sample_count / spec.samples_per_shard),
        expected_splits={name: stop - start for name, (start, stop) in zip(SPLITS, pairwise(ends), strict=True)},
    )


def _axes_of(spec: JobSpec, document: type[Document], seeds: Collection[SeedRule]) -> set[str]:
    """Return the axes that a document of a sample depends on."""
    entering = {axis for rule in seeds for axis in spec.seed_axes(rule)}
    return entering | {
        axis
        for axis in spec.named_axes
        if any(path.partition("/")[0] in document.model_fields for path in spec.fields_of(axis))
    }


def _distinct(spec: JobSpec, names: Collection[str]) -> int:
    """Return how many different values some axes take together over the grid."""
    axes = [(place, axis) for place, (name, axis) in enumerate(spec.named_axes.items()) if name in names]
    # A narrow range holds fewer numbers than it may be asked for, and zipped lists may repeat values.
    if spec.combine == "product":
        return prod(len(set(axis_values(axis))) for _, axis in axes)
    import numpy as np  # the extra `arrays`

    rows = np.zeros(spec.sample_count, dtype=np.int64)
    for place, axis in axes:
        values = axis_values(axis, dimension=place)
        codes = {value: code for code, value in enumerate(dict.fromkeys(values))}
        if len(codes) == spec.sample_count:  # zipped axes have one length: this one tells all samples apart
            return spec.sample_count
        _, rows = np.unique(rows * len(codes) + [codes[value] for value in values], return_inverse=True)
    return int(rows.max()) + 1
