"""Codecs of samples: what is written is read, by us and as the metadata say it."""

import numpy as np
import pytest
from numcodecs import blosc
from stickslip_schemas.format.codecs import (
    CorruptChunkError,
    axes_order,
    decode_sample,
    encode_sample,
)
from stickslip_schemas.spec.arrays import ArrayLayout

SHAPE = (6, 24, 20, 3)
CLIP = ArrayLayout(
    "video", "uint8", SHAPE, ("frame", "y", "x", "rgb"), "", per_sample=True, is_clip=True
)
TRAJECTORY = ArrayLayout(
    "positions", "float32", SHAPE, ("t", "a", "b", "xyz"), "", is_trajectory=True
)
PLAIN = ArrayLayout("views", "uint8", SHAPE, ("view", "y", "x", "rgb"), "", per_sample=True)


def moving() -> np.ndarray:
    """Return a noisy picture in six frames, in which a square moves."""
    clip = np.repeat(
        np.random.default_rng(3).integers(0, 250, (1, *SHAPE[1:]), dtype=np.uint8), SHAPE[0], axis=0
    )
    for frame, picture in enumerate(clip):
        picture[4:9, frame : frame + 5] = 200
    return clip


@pytest.mark.parametrize("array", [CLIP, TRAJECTORY, PLAIN], ids=lambda array: array.name)
def test_what_is_written_is_read(array: ArrayLayout) -> None:
    values = moving().astype(array.dtype)
    out = np.empty_like(values)
    decode_sample(array, encode_sample(array, values), out)
    assert np.array_equal(out, values)


def test_a_clip_is_turned_as_the_metadata_say_and_is_smaller() -> None:
    clip = moving()
    chunk = encode_sample(CLIP, clip)
    assert len(chunk) < clip.nbytes / 3  # six frames that are nearly the same
    order = axes_order(CLIP)
    assert order is not None
    turned = clip[None].transpose(order)
    assert blosc.decompress(chunk[:-4]) == turned.tobytes()


def test_a_clip_of_another_size_is_refused() -> None:
    chunk = encode_sample(CLIP, moving())
    with pytest.raises(CorruptChunkError, match=f"decodes to {np.prod(SHAPE)} bytes"):
        decode_sample(CLIP, chunk, np.empty((5, *SHAPE[1:]), dtype=np.uint8))
