"""Counting by arithmetic gives what walking the grid gives."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.costs import count
from stickslip_schemas.plan.points import keyed_points

BUILDS = Builds(sim_core="9" * 64, simulate="a" * 64, render="b" * 64, pack="c" * 64)


def numbers(low: float, high: float, length: int | None = None) -> st.SearchStrategy[Any]:
    """Axes of numbers in [low, high], of a given length or of any.

    Some ranges are so narrow that values repeat.
    """
    sizes = st.integers(1, 4) if length is None else st.just(length)
    values = st.floats(low, high, allow_nan=False)
    lists = sizes.flatmap(
        lambda size: st.lists(values, min_size=size, max_size=size, unique=length is None)
    )
    start = high / 2
    narrow = st.just({"type": "linspace", "start": start, "stop": start * (1 + 3e-16)})
    wide = st.just({"type": "linspace", "start": low, "stop": high})
    drawn = st.sampled_from(["random", "sobol"]).map(
        lambda kind: {"type": kind, "low": start, "high": start * (1 + 3e-16), "seed": 3}
    )
    ranges = st.tuples(narrow | wide | drawn, sizes).map(lambda pair: pair[0] | {"num": pair[1]})
    return lists | ranges


def words(known: list[str], length: int | None = None) -> st.SearchStrategy[Any]:
    size = (1, 3) if length is None else (length, length)
    return st.lists(
        st.sampled_from(known), min_size=size[0], max_size=size[1], unique=length is None
    )


@st.composite
def specs(draw: st.DrawFn) -> dict[str, Any]:
    combine = draw(st.sampled_from(["product", "zip"]))
    length = draw(st.integers(1, 3)) if combine == "zip" else None
    rest = {
        "combine": combine,
        "samples_per_shard": draw(st.integers(1, 5)),
        "seed": draw(st.integers(0, 3)),
    }
    if draw(st.booleans()):
        axes = {name: draw(numbers(1.0, 40.0, length)) for name in ("gamma", "phi0", "phi1")}
        return {
            "kind": "rod_hang",
            "axes": axes,
            "views": draw(st.sampled_from(["rod-4", None])),
            **rest,
        }
    axes = {
        "material": draw(words(["gray-interlock", "royal-target", "camel-ponte-roma"], length)),
        "mu": draw(numbers(0.1, 0.9, length)),
        "texture": draw(words(["dots", "plaid", "checker"], length)),
        "viewpoint": draw(words(["left", "right", "calibrated"], length)),
    }
    if draw(st.booleans()):
        axes["bending"] = draw(numbers(0.5, 2.0, length))
    if draw(st.booleans()):
        axes["substrate"] = draw(words(["matt", "ceramic", "any"], length))
    return {"kind": "cloth_drag", "axes": axes, **rest}


@pytest.mark.physics
@settings(deadline=None, max_examples=150)
@given(document=specs())
def test_counts_are_those_of_the_grid(document: dict[str, Any]) -> None:
    spec = job_spec_adapter.validate_python(document)
    points = list(keyed_points(spec, BUILDS))
    counts = count(spec)
    assert counts.sample_count == len(points)
    assert counts.simulation_count == len({point.simulation_key for point in points})
    assert counts.render_count == len(
        {point.render_key for point in points if point.render_key is not None}
    )
    assert counts.shards == -(-len(points) // spec.samples_per_shard)
    assert sum(counts.expected_splits.values()) == counts.sample_count
    assert counts.task_count == counts.simulation_count + counts.render_count + counts.shards + 1


def test_splits_are_about_what_is_expected() -> None:
    wide = {"type": "linspace", "start": 1, "stop": 9, "num": 100}
    spec = job_spec_adapter.validate_python(
        {"kind": "rod_hang", "axes": {"gamma": wide, "phi0": wide, "phi1": 1}}
    )
    counts = count(spec)
    assert counts.expected_splits == {"train": 8000, "validation": 1000, "test": 1000}
    drawn = [0, 0, 0]
    for point in keyed_points(spec, BUILDS):
        drawn[point.split] += 1
    for real, expected in zip(drawn, counts.expected_splits.values(), strict=True):
        assert abs(real - expected) < 5 * (expected * (1 - expected / 10_000)) ** 0.5


@pytest.mark.parametrize("combine", ["product", pytest.param("zip", marks=pytest.mark.physics)])
def test_a_million_samples_are_counted(combine: str) -> None:
    size = 100 if combine == "product" else 1_000_000
    axis = {"type": "linspace", "start": 1, "stop": 9, "num": size}
    spec = job_spec_adapter.validate_python(
        {
            "kind": "rod_hang",
            "combine": combine,
            "axes": {"gamma": axis, "phi0": axis, "phi1": axis},
        }
    )
    assert count(spec).simulation_count == 1_000_000
