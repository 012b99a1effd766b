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
    ArrayLayout("sheet-1.areal_density", "float32", (), (), "density"),
    ArrayLayout("step", "float64", (), (), "evenly spaced"),
    ArrayLayout("composed", "bool", (), (), "from a trace"),
    ArrayLayout("light", "float32", (3,), ("of_light",), "lamp"),
    *COMMON_ARRAYS,
)
LABELS = {
    "mu": np.array([0.1, 0.4, 0.5, np.nan]),
    "material": np.array([0, 1, 0, 1], dtype=np.int16),
    "sheet-1.areal_density": np.array([0.2, 1.0, 0.5, 0.1]),
    "step": np.array([0.30000000000000004, -5.6e-17, 0.6, 0.3]),
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
        (Selection(where=("sheet-1.areal_density<1",)), [0, 2]),
        (Selection(where=("step==0.3",)), [0]),
        (Selection(where=("step<=0.3",)), [0, 1]),
        (Selection(where=("step<0.3",)), [1]),
        (Selection(where=("step>0.3",)), [2]),
        (Selection(where=("step!=0.3",)), [1, 2]),
        (Selection(where=("step=0",)), [1]),
    ],
)
def test_samples_of_a_part(selection: Selection, slots: list[int]) -> None:
    assert np.flatnonzero(selection.choose_samples(ARRAYS, LABELS.__getitem__)).tolist() == slots


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        ("mu", "must be a label, one of"),
        ("mu<", "must be a label, one of"),
        ("my<0.5", "must name one of the labels mu, material, sheet-1.areal_density, step"),
        ("video<3", "must name one of the labels"),
        ("light<3", "must name one of the labels"),
        ("mu<low", "mu must be compared with a number"),
        ("material<royal-target", "must compare material with =="),
        ("material==denim", "material must be one of royal-target, camel-ponte-roma"),
        ("composed==1", "composed must be true or false"),
        ("composd==true", r"did you mean composed\?"),
        ("mu<nan", "mu must be compared with a number"),
        ("mu<1<2", "must be compared with a number"),
        ("mu>1", "no valid sample is in this part of the dataset: mu>1"),
        ("step==0.31", r"no sample has step 0\.31: the nearest values are .*0\.3, 0\.6; where is"),
        ("step==0.4", r"no sample has step 0\.4: the nearest values are .*0\.3, 0\.6; where is"),
    ],
)
def test_conditions_that_make_no_sense(condition: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Selection(where=(condition,)).choose_samples(ARRAYS, LABELS.__getitem__)


def test_labels_come_with_every_part() -> None:
    chosen = [array.name for array in Selection(arrays=("mu",)).choose_arrays(ARRAYS)]
    assert chosen == [
        "mu",
        "material",
        "sheet-1.areal_density",
        "step",
        "composed",
        "light",
        "split",
        "valid",
        "sample_key",
    ]
    assert Selection(arrays=("video",)).choose_arrays(ARRAYS) == ARRAYS
    with pytest.raises(ValueError, match="got 'movie'"):
        Selection(arrays=("movie",)).choose_arrays(ARRAYS)
