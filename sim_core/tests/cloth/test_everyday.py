"""Everyday scenes at a coarse mesh: right, refused, or not valid for the true reason."""

import pytest
from stickslip_testing.everyday import EVERYDAY

pytestmark = pytest.mark.physics


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name == "squeezed" else ()) for name in EVERYDAY],
)
def test_everyday_scene(name: str) -> None:
    scene, allowed = EVERYDAY[name]
    assert scene(8) in allowed
