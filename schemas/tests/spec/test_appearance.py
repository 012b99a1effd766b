"""Clips: which frames of a trajectory they show."""

import pytest
from stickslip_schemas.spec.arrays import shown_frames


def test_a_clip_shows_the_first_frame_and_then_evenly_spread_ones() -> None:
    assert shown_frames(30, 300) == tuple(range(0, 300, 10))
    assert shown_frames(300, 300) == tuple(range(300))
    assert shown_frames(7, 300) == (0, 42, 85, 128, 171, 214, 257)
    assert shown_frames(1, 300) == (0,)


@pytest.mark.parametrize("count", [0, 301])
def test_no_clip_has_more_frames_than_its_trajectory(count: int) -> None:
    with pytest.raises(ValueError, match=f"frames must be from 1 to 300, and is {count}"):
        shown_frames(count, 300)
