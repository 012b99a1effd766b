"""From a spec to its samples, by whole shards: simulation, render, split and keys of each; their numbers and costs.

All keys are content keys: SHA-256 of exactly what a result depends on, its build included.

Costs are from tasks that a service has measured or, of other stages, from the records of the package. These were fitted
to measured jobs of 1 to 768 samples on two shared virtual cores. Another machine, fabric or motion makes them larger or
smaller: the 80 % intervals say by how much, and are guessed.
"""

import re
from bisect import bisect_right
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from math import ceil, prod
from typing import Any, NamedTuple

from pydantic import Field

from stickslip_schemas.base import Document, Stage, canonical_json, content_key, keyed_text, placed, seed_of_key, sha256
from stickslip_schemas.kinds import registered
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.arrays import SPLITS
from stickslip_schemas.spec.axes import axis_values
from stickslip_schemas.spec.jobs import JobSpec, SeedRule


class KeyedPoint(NamedTuple):
    """One slot of a dataset. Texts are canonical JSON; those of the render are None where nothing is rendered."""

    slot: int
    labels: dict[str, Any]
    labels_text: str
    simulation_text: str
    simulation_key: str
    render_text: str | None
    render_key: str | None
    split: int

    @property
    def key(self) -> str:
        """Key of everything the sample is made from."""
        return self.render_key or self.simulation_key


def keyed_points(spec: JobSpec, builds: Builds, *, first: int = 0) -> Iterator[KeyedPoint]:
    """Yield the samples of `spec` as `builds` would make them, from slot `first` on.

    The canonical JSON of one sample differs from that of the next only in what its axes and seeds set. So it is
    composed once, with holes, and the holes are filled in for each point: ten times as fast as by way of models.

    Raises UnknownKindError where the class of the spec is not that of its kind.
    """
    registered(spec)
    names = tuple(spec.named_axes)
    columns = spec.columns()
    some = dict(zip(names, next(spec.combined(columns)), strict=True))
    simulation = _Template.of(spec, spec.simulation(some), some, spec.simulation_seeds)
    shown = spec.render(some)
    render = None if shown is None else _Template.of(spec, shown, some, spec.render_seeds)

    labels_text = _format({name: _hole(name) for name in names})
    simulation_text = _format(simulation.document)
    simulation_keyed = _format({"simulation": simulation.document, "build": builds.simulate}, "simulate")
    drawn = {name: _hole(name) for name in names} if spec.splits.by == "clip" else simulation.unseeded
    bounds = spec.splits.train, spec.splits.train + spec.splits.validation
    split_seed = _format({"seed": spec.seed, "for": drawn}, "seed/split")
    render_text = render_keyed = ""
    if render is not None:
        render_text = _format(render.document)
        render_keyed = _format(
            {"render": render.document, "simulation": _hole("simulation"), "build": builds.render}, "render"
        )

    # A zipped axis may have a million values, of which each is needed once: its texts are made when it comes.
    start = first if spec.combine == "zip" else 0
    filled = [_filled(spec, name, column[start:]) for name, column in zip(names, columns, strict=True)]
    for slot, cells in enumerate(islice(spec.combined(filled), first - start, None), start=first):
        point: dict[str, Any] = {}
        texts: dict[str, str] = {}
        for name, (value, own) in zip(names, cells, strict=True):
            point[name] = value
            texts.update(own)
        split = bisect_right(bounds, _seed_of(split_seed % texts) / 2**31)
        simulation.draw(texts)
        key = sha256((simulation_keyed % texts).encode())
        labels, physics = labels_text % texts, simulation_text % texts
        if render is None:
            yield KeyedPoint(slot, point, labels, physics, key, None, None, split)
            continue
        render.draw(texts)
        texts["simulation"] = f'"{key}"'
        shown_key = sha256((render_keyed % texts).encode())
        yield KeyedPoint(slot, point, labels, physics, key, render_text % texts, shown_key, split)


class Shard(NamedTuple):
    """A shard group: consecutive samples whose chunks lie in the same files."""

    number: int
    points: tuple[KeyedPoint, ...]
    pack_key: str


def shards(spec: JobSpec, builds: Builds, *, first: int = 0) -> Iterator[Shard]:
    """Yield the shards of `spec` from number `first` on; see `keyed_points`."""
    points = keyed_points(spec, builds, first=first * spec.samples_per_shard)
    number = first
    while members := tuple(islice(points, spec.samples_per_shard)):
        slots = [(point.key, point.split) for point in members]
        yield Shard(number, members, pack_key(spec, number, slots, builds))
        number += 1


def pack_key(spec: JobSpec, shard: int, slots: Sequence[tuple[str, int]], builds: Builds) -> str:
    """Return the content key of a shard group: its slots (sample key, split), its arrays, and the packer's build.

    The arrays are part of it because they depend on the spec, too: on the names of the codes of a label, for example.
    """
    content = {
        "kind": spec.kind,
        "shard": shard,
        "samples_per_shard": spec.samples_per_shard,
        "slots": slots,
        "arrays": spec.arrays_digest,
        "build": builds.pack,
    }
    return content_key("pack", content)


def publish_key(spec: JobSpec, pack_keys: Sequence[str], builds: Builds, certificate: str | None = None) -> str:
    """Return the content key of a dataset version: spec, shards and certificate."""
    content: dict[str, Any] = {"spec": spec.content_digest, "shards": list(pack_keys), "builds": builds.digest}
    if certificate is not None:
        content["certificate"] = certificate
    return content_key("publish", content)


# --- documents with holes ---------------------------------------------------------------------------------------------


class _Template(NamedTuple):
    """A document whose fields that differ between samples are holes, and the seeds that it draws."""

    document: dict[str, Any]
    unseeded: dict[str, Any]
    seeds: tuple[tuple[str, str], ...]
    """Name of the hole of each seed, and the text it is drawn from."""

    @classmethod
    def of(cls, spec: JobSpec, model: Document, point: Mapping[str, Any], rules: tuple[SeedRule, ...]) -> "_Template":
        dumped = model.model_dump(mode="json")
        varying = {field for axis, value in point.items() for field in spec.document_fields(axis, value)}
        seeds = {rule.field for rule in rules}
        document = {name: _hole(f"{type(model).__name__}/{name}") if name in seeds else dumped[name] for name in dumped}
        for path in varying:
            name, *inner = path.split("/")
            if name in dumped:
                document[name] = placed(document[name], inner, _hole(path))
        return cls(
            document,
            {name: value for name, value in document.items() if name not in seeds},
            tuple(
                (
                    f"{type(model).__name__}/{rule.field}",
                    _format(
                        {"seed": spec.seed, "for": {axis: _hole(axis) for axis in spec.seed_axes(rule)}},
                        f"seed/{rule.purpose}",
                    ),
                )
                for rule in rules
            ),
        )

    def draw(self, texts: dict[str, str]) -> None:
        for hole, text in self.seeds:
            texts[hole] = str(_seed_of(text % texts))


def _hole(name: str) -> str:
    return f"\x00{name}\x00"  # no value holds a NUL


def _filled(spec: JobSpec, name: str, column: list[Any]) -> Iterator[tuple[Any, dict[str, str]]]:
    """Yield the values of an axis, each with the texts that it puts into holes: its own, and of the fields it sets."""
    for value in column:
        fields = {**spec.document_fields(name, value), name: value}
        yield value, {field: canonical_json(given) for field, given in fields.items()}


def _format(document: Any, purpose: str | None = None) -> str:
    """Return the canonical JSON of `document` (what `content_key` hashes, with a purpose) as a %-format."""
    text = canonical_json(document)
    text = (text if purpose is None else keyed_text(purpose, text)).replace("%", "%%")
    return re.sub(r'"\\u0000([\w/-]+)\\u0000"', r"%(\1)s", text)


def _seed_of(text: str) -> int:
    return seed_of_key(sha256(text.encode()))


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
