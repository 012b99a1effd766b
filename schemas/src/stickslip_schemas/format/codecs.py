"""How the values of one sample are coded, by what they are: clips, trajectories, and all else.

A clip is `transpose -> zstd(CLIP_LEVEL) -> crc32c`: the same row of all frames is together, for most of it is as it was
in the frame before. The other two are in `stickslip_schemas.format.chunks`.
"""

import threading

import numpy as np

from stickslip_schemas.format.chunks import ZSTD_LEVEL, decode_chunk, decode_trajectory, encode_chunk, encode_trajectory
from stickslip_schemas.spec.arrays import ArrayLayout

CLIP_LEVEL = 11
"""Of zstd, for clips: written once, read many times, and reading is as fast as at level 3."""

_ROWS_FIRST = (1, 0, 2, 3)

_scratch = threading.local()
"""The last buffer of a thread to decode clips into: memory that is new to the process costs a tenth of the decoding."""


def encode_clip(clip: np.ndarray) -> bytes:
    """Return the encoded chunk of a clip (frames, height, width, 3) of uint8."""
    return encode_chunk(np.ascontiguousarray(clip.transpose(_ROWS_FIRST)), CLIP_LEVEL)


def decode_clip(chunk: bytes, out: np.ndarray) -> None:
    """Decode a chunk that `encode_clip` has made into all of `out`; raise CorruptChunkError.

    It is a third of a millisecond quicker where the rows of `out` are together in memory, as they are in the chunk.
    """
    if (rows := out.transpose(_ROWS_FIRST)).flags.c_contiguous:
        decode_chunk(chunk, rows)
        return
    shape = tuple(out.shape[axis] for axis in _ROWS_FIRST)
    turned = getattr(_scratch, "turned", None)
    if turned is None or turned.shape != shape or turned.dtype != out.dtype:
        turned = _scratch.turned = np.empty(shape, dtype=out.dtype)
    decode_chunk(chunk, turned)
    out[...] = turned.transpose(_ROWS_FIRST)


def encode_sample(array: ArrayLayout, values: np.ndarray) -> bytes:
    """Return the encoded chunk of one sample's values of an array."""
    if array.is_clip:
        return encode_clip(values)
    return encode_trajectory(values) if array.is_trajectory else encode_chunk(values)


def decode_sample(array: ArrayLayout, chunk: bytes, out: np.ndarray) -> None:
    """Decode the chunk of one sample of an array into all of `out`; raise CorruptChunkError."""
    if array.is_clip:
        decode_clip(chunk, out)
    elif array.is_trajectory:
        decode_trajectory(chunk, out)
    else:
        decode_chunk(chunk, out)


def axes_order(array: ArrayLayout) -> tuple[int, ...] | None:
    """Return how the axes (sample, ...) of an array are turned before its chunks are coded; None: not at all."""
    if array.is_clip:
        return (0, *(1 + axis for axis in _ROWS_FIRST))
    return (0, *range(len(array.shape), 0, -1)) if array.is_trajectory else None


def in_order_of_chunks(array: ArrayLayout, values: np.ndarray) -> bool:
    """Tell whether samples (samples, *sample shape) of an array lie in memory in the order that chunks have."""
    return bool((values.transpose(axes_order(array)) if array.is_clip else values).flags.c_contiguous)


def empty_in_order(array: ArrayLayout, count: int) -> np.ndarray:
    """Return an array (count, *sample shape) in that order: decoding clips into it needs no copy."""
    shape = (count, *array.shape)
    if not array.is_clip:
        return np.empty(shape, dtype=array.dtype)
    order = axes_order(array)  # its own inverse
    assert order is not None
    return np.empty([shape[axis] for axis in order], dtype=array.dtype).transpose(order)


def zstd_level(array: ArrayLayout) -> int:
    """Return the level of zstd that an array's chunks are written with, where they are no trajectory."""
    return CLIP_LEVEL if array.is_clip else ZSTD_LEVEL
