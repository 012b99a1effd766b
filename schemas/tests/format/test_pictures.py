"""Previews of pictures of any shape."""

import io

import numpy as np
import pytest
from PIL import Image
from stickslip_schemas.format.pictures import labelled, moving


@pytest.mark.parametrize(
    ("shape", "size"),
    [((224, 224), (160, 160)), ((640, 360), (90, 160)), ((480, 640), (160, 120)), ((90, 64), None)],
)
def test_the_longer_side_of_a_preview_is_given(
    shape: tuple[int, int], size: tuple[int, int] | None
) -> None:
    """A smaller picture keeps its size."""
    clip = np.zeros((2, *shape, 3), dtype=np.uint8)
    clip[1] = 200
    with Image.open(io.BytesIO(moving(clip, side=160))) as preview:
        assert preview.size == (size or (shape[1], shape[0]))


def test_a_tile_shows_the_whole_picture_with_white_beside_it() -> None:
    dark = np.full((1, 60, 30, 3), 40, dtype=np.uint8)
    tile = labelled(dark, "mu 0.3", 20)[0][-20:]
    assert tile.shape == (20, 20, 3)
    assert (tile[:, 5:15] == 40).all()
    assert (tile[:, :5] == 255).all()
    assert (tile[:, 15:] == 255).all()
