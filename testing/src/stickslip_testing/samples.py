"""Samples of a spec by its models: slow and plain.

`stickslip_schemas.plan.points` must agree with them.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from stickslip_schemas.base import content_key, derived_seed
from stickslip_schemas.kinds import registered
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.jobs import JobSpec, Render, Simulation


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


def samples(spec: JobSpec, builds: Builds) -> Iterator[Sample]:
    """Yield the samples of `spec` as `builds` would make them."""
    registered(spec)
    for slot, point in enumerate(spec.grid()):
        simulation, render = spec.simulation(point), spec.render(point)
        key = simulation_key(simulation, builds)
        yield Sample(
            slot,
            point,
            simulation,
            key,
            render,
            None if render is None else render_key(render, key, builds),
            split_of(spec, point),
        )


def simulation_key(simulation: Simulation, builds: Builds) -> str:
    """Return the content key of a trajectory: its physics and the build that makes it."""
    return content_key(
        "simulate", {"simulation": simulation.model_dump(mode="json"), "build": builds.simulate}
    )


def render_key(render: Render, of_simulation: str, builds: Builds) -> str:
    """Return the content key of a render: trajectory, appearance and the renderer's build."""
    return content_key(
        "render",
        {
            "render": render.model_dump(mode="json"),
            "simulation": of_simulation,
            "build": builds.render,
        },
    )


def split_of(spec: JobSpec, point: Mapping[str, Any]) -> int:
    """Return the number of the split of a sample: a hash of its physics.

    No build or order moves a sample to another split.

    With `by: clip` it is a hash of all its axes.
    """
    if spec.splits.by == "clip":
        drawn = dict(point)
    else:
        seeds = {rule.field for rule in spec.simulation_seeds}
        drawn = spec.simulation(point).model_dump(mode="json", exclude=seeds)
    position = derived_seed(spec.seed, "split", drawn) / 2**31
    return int(position >= spec.splits.train) + int(
        position >= spec.splits.train + spec.splits.validation
    )
