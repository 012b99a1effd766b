"""Everyday scenes at a coarse mesh: right, refused, or not valid for the true reason."""

import pytest
from stickslip_testing.everyday import EVERYDAY

pytestmark = pytest.mark.physics


@pytest.mark.parametrize("name", EVERYDAY)
def test_everyday_scene(name: str) -> None:
    scene, allowed = EVERYDAY[name]
    assert scene(8) in allowed
