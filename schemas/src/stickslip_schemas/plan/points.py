"""From a spec to its samples: which simulation, which render and which split each of them is."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, product
from typing import Any, NamedTuple, Protocol

from stickslip_schemas.base.document import Document
from stickslip_schemas.base.keys import canonical_json, content_key, derived_seed, keyed_text, seed_of_key, sha256
from stickslip_schemas.kinds import registered
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.axes import axis_values
from stickslip_schemas.spec.jobs import JobSpec, Render, SeedRule, Simulation, Splits


@dataclass(frozen=True, slots=True)
class Sample:
    """One slot of a dataset. Keys are content keys; `render` is None where nothing is rendered."""

    slot: int
    labels: dict[str, Any]
    simulation: Simulation
    simulation_key: str
    render: Render | None
    render_key: str | None
    split: int

    @property
    def key(self) -> str:
        """Key of everything the sample is made from."""
        return self.render_key or self.simulation_key


class Keyed(Protocol):
    """What the key of a shard depends on, of each of its samples."""

    @property
    def key(self) -> str: ...

    @property
    def split(self) -> int: ...


def simulation_key(simulation: Simulation, builds: Builds) -> str:
    """Return the content key of a trajectory: its physics and the build that makes it."""
    return content_key("simulate", {"simulation": simulation.model_dump(mode="json"), "build": builds.simulate})


def render_key(render: Render, of_simulation: str, builds: Builds) -> str:
    """Return the content key of a render: its trajectory, its appearance and the renderer's build."""
    return content_key(
        "render",
        {"render": render.model_dump(mode="json"), "simulation": of_simulation, "build": builds.render},
    )


def pack_key(spec: JobSpec, shard: int, members: Sequence[Keyed], builds: Builds) -> str:
    """Return the content key of a shard group: its slots' samples and splits, its arrays, and the packer's build.

    The arrays are part of it because they depend on the spec, too: on the names of the codes of a label, for example.
    """
    content = {
        "kind": spec.kind,
        "shard": shard,
        "samples_per_shard": spec.samples_per_shard,
        "slots": [[sample.key, sample.split] for sample in members],
        "arrays": spec.arrays_digest,
        "build": builds.pack,
    }
    return content_key("pack", content)


def publish_key(spec: JobSpec, pack_keys: Sequence[str], builds: Builds, certificate: str | None = None) -> str:
    """Return the content key of a dataset version: what was asked for, its shards, and who vouches for them."""
    content: dict[str, Any] = {"spec": spec.content_digest, "shards": list(pack_keys), "builds": builds.digest}
    if certificate is not None:
        content["certificate"] = certificate
    return content_key("publish", content)


def dataset_id(spec: JobSpec) -> str:
    """Return the id of the dataset that answers `spec`: the same spec has the same dataset, in any build."""
    return f"ds-{spec.content_digest[:16]}"


def grid(spec: JobSpec) -> Iterator[dict[str, Any]]:
    """Yield the point of the parameter grid of each sample, in the order of the slots."""
    names = tuple(spec.named_axes)
    for point in _combined(spec, _columns(spec)):
        yield dict(zip(names, point, strict=True))


def _columns(spec: JobSpec) -> list[list[Any]]:
    zipped = spec.combine == "zip"
    axes = spec.named_axes.values()
    return [axis_values(axis, dimension=position if zipped else 0) for position, axis in enumerate(axes)]


def _combined(spec: JobSpec, columns: Sequence[Iterable[Any]]) -> Iterator[tuple[Any, ...]]:
    return zip(*columns, strict=True) if spec.combine == "zip" else product(*columns)


class KeyedPoint(NamedTuple):
    """A sample as texts and keys, without its models: what a queue needs of a hundred thousand of them at once.

    The texts are canonical JSON; `render_text` and `render_key` are None where nothing is rendered.
    """

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
    """Yield what `samples` yields from slot `first` on, with the very same keys, some ten times as fast.

    The canonical JSON of one sample differs from that of the next only in what its axes and seeds set. So it is
    composed once, with holes, and the holes are filled in for each point.
    """
    registered(spec)
    names = tuple(spec.named_axes)
    columns = _columns(spec)
    some = dict(zip(names, next(_combined(spec, columns)), strict=True))
    simulation = _Template.of(spec, spec.simulation(some), some, spec.simulation_seeds)
    shown = spec.render(some)
    render = None if shown is None else _Template.of(spec, shown, some, spec.render_seeds)

    labels_text = _format({name: _hole(name) for name in names})
    simulation_text = _format(simulation.document)
    simulation_keyed = _format({"simulation": simulation.document, "build": builds.simulate}, "simulate")
    drawn = {name: _hole(name) for name in names} if spec.splits.by == "clip" else simulation.unseeded
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
    for slot, cells in enumerate(islice(_combined(spec, filled), first - start, None), start=first):
        point: dict[str, Any] = {}
        texts: dict[str, str] = {}
        for name, (value, own) in zip(names, cells, strict=True):
            point[name] = value
            texts.update(own)
        split = _split_at(spec.splits, _seed_of(split_seed % texts))
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


def samples(spec: JobSpec, builds: Builds) -> Iterator[Sample]:
    """Yield the samples of `spec` as `builds` would make them."""
    for point in keyed_points(spec, builds):
        yield Sample(
            slot=point.slot,
            labels=point.labels,
            simulation=spec.simulation(point.labels),
            simulation_key=point.simulation_key,
            render=spec.render(point.labels),
            render_key=point.render_key,
            split=point.split,
        )


def split_of(spec: JobSpec, point: Mapping[str, Any]) -> int:
    """Return the number of the split of a sample: a hash of its physics, so that no build or order moves it.

    With `by: clip` it is a hash of all its axes.
    """
    if spec.splits.by == "clip":
        return _split_at(spec.splits, derived_seed(spec.seed, "split", dict(point)))
    seeds = {rule.field for rule in spec.simulation_seeds}
    physics = spec.simulation(point).model_dump(mode="json", exclude=seeds)
    return _split_at(spec.splits, derived_seed(spec.seed, "split", physics))


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
        document = {
            name: _hole(f"{type(model).__name__}/{name}")
            if name in seeds
            else _hole(name)
            if name in varying
            else value
            for name, value in dumped.items()
        }
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
        """Fill in the seeds of a point."""
        for hole, text in self.seeds:
            texts[hole] = str(_seed_of(text % texts))


def _hole(name: str) -> str:
    return f"\x00{name}\x00"  # no value holds a NUL


def _filled(spec: JobSpec, name: str, column: list[Any]) -> Iterator[tuple[Any, dict[str, str]]]:
    for value in column:
        yield value, _texts(spec, name, value)


def _texts(spec: JobSpec, axis: str, value: Any) -> dict[str, str]:
    """Return the texts that a value of an axis puts into holes: of the axis itself, and of the fields it sets."""
    return {name: canonical_json(given) for name, given in {**spec.document_fields(axis, value), axis: value}.items()}


def _format(document: Any, purpose: str | None = None) -> str:
    """Return the canonical JSON of `document` (what `content_key` hashes, with a purpose) as a %-format."""
    text = canonical_json(document)
    text = (text if purpose is None else keyed_text(purpose, text)).replace("%", "%%")
    return re.sub(r'"\\u0000([\w/]+)\\u0000"', r"%(\1)s", text)


def _seed_of(text: str) -> int:
    return seed_of_key(sha256(text.encode()))


def _split_at(splits: Splits, seed: int) -> int:
    position = seed / 2**31
    if position < splits.train:
        return 0
    return 1 if position < splits.train + splits.validation else 2
