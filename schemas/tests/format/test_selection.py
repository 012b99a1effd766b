"""Parts of a dataset version."""

import numpy as np
import pytest
from stickslip_schemas.format.selection import Selection
from stickslip_schemas.spec.arrays import COMMON_ARRAYS, ArrayLayout

ARRAYS = (
    ArrayLayout(
        "video", "uint8", (2, 8, 8, 3), ("frame", "y", "x", "rgb"), "clip", per_sample=True
    ),
    ArrayLayout("mu", "float64", (), (), "friction"),
    ArrayLayout(
        "material", "int16", (), (), "fabric", categories=("royal-target", "camel-ponte-roma")
    ),
    ArrayLayout("composed", "bool", (), (), "from a trace"),
    ArrayLayout("light", "float32", (3,), ("of_light",), "lamp"),
    *COMMON_ARRAYS,
)
LABELS = {
    "mu": np.array([0.1, 0.4, 0.5, np.nan]),
    "material": np.array([0, 1, 0, 1], dtype=np.int16),
    "composed": np.array([True, False, True, True]),
    "valid": np.array([True, True, True, False]),
    "split": np.array([0, 1, 2, 0], dtype=np.uint8),
}


@pytest.mark.parametrize(
    ("selection", "slots"),
    [
        (Selection(), [0, 1, 2]),
        (Selection(split="validation"), [1]),
        (Selection(where=("mu<0.5",)), [0, 1]),
        (Selection(where=("mu <= 0.5", "material = royal-target")), [0, 2]),
        (Selection(where=("material!=royal-target",)), [1]),
        (Selection(where=("composed == False",)), [1]),
        (Selection(where=("mu>1",)), []),
    ],
)
def test_samples_of_a_part(selection: Selection, slots: list[int]) -> None:
    assert np.flatnonzero(selection.choose_samples(ARRAYS, LABELS.__getitem__)).tolist() == slots


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        ("mu", "must be a label, one of"),
        ("mu<", "must be a label, one of"),
        ("my<0.5", "must name one of the labels mu, material, composed, split, valid"),
        ("video<3", "must name one of the labels"),
        ("light<3", "must name one of the labels"),
        ("mu<low", "mu must be compared with a number"),
        ("material<royal-target", "must compare material with =="),
        ("material==denim", "material must be one of royal-target, camel-ponte-roma"),
        ("composed==1", "composed must be true or false"),
    ],
)
def test_conditions_that_make_no_sense(condition: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Selection(where=(condition,)).choose_samples(ARRAYS, LABELS.__getitem__)


def test_labels_come_with_every_part() -> None:
    chosen = [array.name for array in Selection(arrays=("mu",)).choose_arrays(ARRAYS)]
    assert chosen == ["mu", "material", "composed", "light", "split", "valid", "sample_key"]
    assert Selection(arrays=("video",)).choose_arrays(ARRAYS) == ARRAYS
    with pytest.raises(ValueError, match="got 'movie'"):
        Selection(arrays=("movie",)).choose_arrays(ARRAYS)
