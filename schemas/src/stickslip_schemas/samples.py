"""From a spec to its samples: which simulation, which render and which split each of them is."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

from stickslip_schemas.axes import axis_values
from stickslip_schemas.builds import Builds
from stickslip_schemas.cameras import load_rig
from stickslip_schemas.jobs import ClothDragSpec, RodHangSpec, Splits
from stickslip_schemas.keys import content_key, derived_seed
from stickslip_schemas.tasks import ClothRender, ClothSimulation, RodRender, RodSimulation

SPLITS = ("train", "validation", "test")
"""Names of the splits, in the order of their numbers in the array `split`."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One slot of a dataset. Keys are content keys; `render` is None where nothing is rendered."""

    slot: int
    labels: dict[str, Any]
    simulation: RodSimulation | ClothSimulation
    simulation_key: str
    render: RodRender | ClothRender | None
    render_key: str | None
    split: int

    @property
    def key(self) -> str:
        """Key of everything the sample is made from."""
        return self.render_key or self.simulation_key


def simulation_key(simulation: RodSimulation | ClothSimulation, builds: Builds) -> str:
    """Return the content key of a trajectory: its physics and the sim_core build."""
    return content_key("simulate", {"simulation": simulation.model_dump(mode="json"), "build": builds.sim_core})


def render_key(render: RodRender | ClothRender, of_simulation: str, builds: Builds) -> str:
    """Return the content key of a render: its trajectory, its appearance and the renderer's build."""
    return content_key(
        "render",
        {"render": render.model_dump(mode="json"), "simulation": of_simulation, "build": builds.blender},
    )


def pack_key(spec: RodHangSpec | ClothDragSpec, shard: int, members: Sequence[Sample], builds: Builds) -> str:
    """Return the content key of a shard group: its slots' samples and splits, and the packer's build."""
    content = {
        "kind": spec.kind,
        "shard": shard,
        "samples_per_shard": spec.samples_per_shard,
        "slots": [[sample.key, sample.split] for sample in members],
        "build": builds.packer,
    }
    return content_key("pack", content)


def publish_key(spec: RodHangSpec | ClothDragSpec, pack_keys: Sequence[str], builds: Builds) -> str:
    """Return the content key of a dataset version: what was asked for, and the shards that answer it."""
    content = {"spec": spec.content_digest, "shards": list(pack_keys), "builds": builds.digest}
    return content_key("publish", content)


def dataset_id(spec: RodHangSpec | ClothDragSpec) -> str:
    """Return the id of the dataset that answers `spec`: the same spec has the same dataset, in any build."""
    return f"ds-{spec.content_digest[:16]}"


def grid(spec: RodHangSpec | ClothDragSpec) -> Iterator[dict[str, Any]]:
    """Yield the point of the parameter grid of each sample, in the order of the slots."""
    zipped = spec.combine == "zip"
    columns = [
        axis_values(axis, dimension=position if zipped else 0) for position, axis in enumerate(spec.named_axes.values())
    ]
    for point in zip(*columns, strict=True) if zipped else product(*columns):
        yield dict(zip(spec.named_axes, point, strict=True))


def samples(spec: RodHangSpec | ClothDragSpec, builds: Builds) -> Iterator[Sample]:
    """Yield the samples of `spec` as `builds` would make them."""
    for slot, point in enumerate(grid(spec)):
        simulation, render = _rod(spec, point) if isinstance(spec, RodHangSpec) else _cloth(spec, point)
        key = simulation_key(simulation, builds)
        yield Sample(
            slot=slot,
            labels=point,
            simulation=simulation,
            simulation_key=key,
            render=render,
            render_key=None if render is None else render_key(render, key, builds),
            split=split_of(spec.splits, spec.seed, simulation),
        )


def _rod(spec: RodHangSpec, point: dict[str, Any]) -> tuple[RodSimulation, RodRender | None]:
    simulation = RodSimulation(**point, poisson=spec.poisson)
    if spec.views is None:
        return simulation, None
    render = RodRender(
        rig=spec.views,
        rig_digest=_rig_digest(spec.views),
        quality=spec.quality,
        color_seed=derived_seed(spec.seed, "color", point),
    )
    return simulation, render


def _cloth(spec: ClothDragSpec, point: dict[str, Any]) -> tuple[ClothSimulation, ClothRender]:
    simulation = ClothSimulation(
        material=point["material"], mu=point["mu"], preset=spec.preset, mesh=spec.mesh, seed=spec.seed
    )
    render = ClothRender(
        texture=point["texture"],
        viewpoint=point["viewpoint"],
        frames=spec.frames,
        quality=spec.quality,
        light_seed=derived_seed(spec.seed, "light", point),
    )
    return simulation, render


def split_of(splits: Splits, seed: int, simulation: RodSimulation | ClothSimulation) -> int:
    """Return the number of the split of `simulation`: a hash of its physics, so no build or order moves it."""
    position = derived_seed(seed, "split", simulation.model_dump(mode="json")) / 2**31
    if position < splits.train:
        return 0
    return 1 if position < splits.train + splits.validation else 2


@cache
def _rig_digest(name: str) -> str:
    return content_key("rig", [camera.model_dump(mode="json") for camera in load_rig(name)])
