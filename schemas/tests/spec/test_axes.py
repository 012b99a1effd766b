"""Axes: their values, and that samples of a range are seeded."""

from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter
from stickslip_schemas.kinds.rod_hang import GammaAxis
from stickslip_schemas.spec.axes import axis_values

_AXIS: TypeAdapter[Any] = TypeAdapter(GammaAxis)


def values(document: Any, dimension: int = 0) -> list[float]:
    return [
        float(value) for value in axis_values(_AXIS.validate_python(document), dimension=dimension)
    ]


def sampled(kind: str, seed: int, num: int = 100) -> dict[str, Any]:
    return {"type": kind, "low": 100, "high": 1300, "num": num, "seed": seed}


def test_linspace_holds_both_ends() -> None:
    assert values({"type": "linspace", "start": 0, "stop": 1, "num": 5}) == [0, 0.25, 0.5, 0.75, 1]
    assert values({"type": "linspace", "start": 3, "stop": 3, "num": 1}) == [3]


@pytest.mark.parametrize("kind", ["random", "sobol"])
def test_samples_are_in_range_and_depend_on_seed_and_dimension(kind: str) -> None:
    first = values(sampled(kind, 0))
    assert first == values(sampled(kind, 0))
    assert first != values(sampled(kind, 1))
    assert first != values(sampled(kind, 0), dimension=1)
    assert all(100 <= value < 1300 for value in first)
    assert len(set(first)) == 100


def test_sobol_fills_evenly() -> None:
    """Each of 2^k equal cells gets one point of a scrambled sequence of 2^k, in every dimension
    [Owen 1995].
    """
    for dimension in range(3):
        unit = (np.array(values(sampled("sobol", 5, 64), dimension)) - 100) / 1200
        assert sorted((unit * 64).astype(int)) == list(range(64))


def test_pinned_samples() -> None:
    """A seed always means the same values: change these only with a change of the format."""
    assert values(sampled("random", 0, 2)) == pytest.approx(PINNED_RANDOM, rel=1e-12)
    assert values(sampled("sobol", 0, 2)) == pytest.approx(PINNED_SOBOL, rel=1e-12)


PINNED_RANDOM = [864.3540247857452, 423.7440565166444]
PINNED_SOBOL = [591.9395063072443, 1004.3366860598326]
