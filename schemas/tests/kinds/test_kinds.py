"""Kinds and the codes of labels, which datasets store."""

from typing import get_args

import pytest
from stickslip_schemas.kinds import KINDS
from stickslip_schemas.kinds.cloth.arrays import KERNELS
from stickslip_schemas.kinds.cloth_drag import VIEWPOINTS
from stickslip_schemas.spec.arrays import SPLITS
from stickslip_schemas.spec.names import Material, Texture


def test_codes_of_labels_are_pinned() -> None:
    """A code is stored in datasets for good: a name may be added at the end, and none may move."""
    assert {name: code for code, name in enumerate(Material)} == {
        "11oz-black-denim": 0,
        "camel-ponte-roma": 1,
        "gray-interlock": 2,
        "ivory-rib-knit": 3,
        "navy-sparkle-sweat": 4,
        "pink-ribbon-brown": 5,
        "royal-target": 6,
        "tango-red-jet-set": 7,
        "white-dots-on-blk": 8,
        "white-swim-solid": 9,
    }
    textures = [
        "checker",
        "dots",
        "stripes",
        "plaid",
        "gingham",
        "herringbone",
        "houndstooth",
        "floral",
    ]
    assert list(Texture)[:8] == textures
    assert list(VIEWPOINTS)[:3] == ["calibrated", "left", "right"]
    assert KERNELS == ("baseline", "x86-64-v3", "x86-64-v4")
    assert SPLITS == ("train", "validation", "test")


@pytest.mark.parametrize("name", KINDS)
def test_a_module_of_the_package_is_a_kind_of_its_name(name: str) -> None:
    spec = KINDS[name]
    assert spec.__module__ == f"stickslip_schemas.kinds.{name}"
    for document in (spec, spec.simulation_type, spec.render_type):
        assert get_args(document.model_fields["kind"].annotation) == (name,)
