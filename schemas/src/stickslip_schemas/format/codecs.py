"""Chunks and shards as bytes [Zarr v3, sharding_indexed codec].

A chunk is `zstd(ZSTD_LEVEL) -> crc32c`. Trajectories and clips are `transpose -> blosc -> crc32c`,
each with its `Packing`. In a clip, the same row of all frames is together, one colour after the
other, for most of it is as it was in the frame before.

A shard is its chunks one after the other, then the index: one (offset, length) pair of
little-endian uint64 per chunk, then the index's own crc32c.
"""

import threading
from collections.abc import Sequence
from typing import NamedTuple

import google_crc32c
import numpy as np
from numcodecs import blosc
from numcodecs.zstd import Zstd

from stickslip_schemas.spec.arrays import ArrayLayout

# With threads of its own, blosc writes its blocks in the order in which they happen to be done.
blosc.use_threads = False

ZSTD_LEVEL = 3


class Packing(NamedTuple):
    """Settings of blosc, with the names that Zarr's metadata have for them."""

    cname: str
    clevel: int
    shuffle: str


TRAJECTORY = Packing("zstd", 5, "shuffle")
CLIP = Packing("lz4hc", 9, "noshuffle")
"""Written once, read many times: it takes a fifth more space than zstd 11, and less than half the
time to decode.
"""
MISSING = 2**64 - 1
"""Offset and length of a chunk that is not in the shard."""

_CLIP_ORDER = (1, 3, 0, 2)
"""Rows, colours, frames, columns: it takes less space than any other order, and is the quickest to
read.
"""

_scratch = threading.local()
"""The last buffer of a thread to decode into: memory that is new to the process costs a tenth of
the decoding.
"""

_CRC_BYTES = 4
_FRAME_BYTES = 1024
"""More than the headers of a frame and its crc32c have [bytes]."""
_RESIDUE = 0x48674BC7
"""The crc32c of any bytes with their own little-endian crc32c behind them."""


class CorruptChunkError(ValueError):
    """A checksum does not hold, or a chunk is not of the size that it should have."""


def encode_chunk(data: bytes | np.ndarray) -> bytes:
    """Return the encoded chunk of C-ordered little-endian `data`."""
    return _with_crc(bytes(Zstd(level=ZSTD_LEVEL).encode(data)))


def largest_chunk(size: int) -> int:
    """Return the most bytes that a chunk of `size` decoded bytes can have [bytes].

    zstd adds 1/256 and a frame to data that it cannot compress [ZSTD_compressBound].
    """
    return size + size // 256 + _FRAME_BYTES


def decode_chunk(chunk: bytes, out: np.ndarray | None = None) -> bytes | np.ndarray:
    """Return the decoded bytes of a chunk, into all of `out` if it is given.

    Raise CorruptChunkError.
    """
    frame = _without_crc(chunk, "chunk")
    size = _content_size(frame)
    # The decoder would fill a part of `out` and leave the rest as it was, without a word.
    if out is not None and size != out.nbytes:
        stated = "an unstated number of" if size is None else size
        raise CorruptChunkError(
            f"the chunk decodes to {stated} bytes, and {out.nbytes} are expected"
        )
    return Zstd().decode(frame, out)  # type: ignore[no-any-return]  # untyped library


def encode_clip(clip: np.ndarray) -> bytes:
    """Return the encoded chunk of a clip (frames, height, width, 3) of uint8."""
    return _packed(clip.transpose(_CLIP_ORDER), CLIP)


def decode_clip(chunk: bytes, out: np.ndarray) -> None:
    """Decode a chunk that `encode_clip` has made into all of `out`; raise CorruptChunkError.

    Nothing is copied if `out` lies in memory as the chunk does.
    """
    _unpack(chunk, out.transpose(_CLIP_ORDER))


def encode_sample(array: ArrayLayout, values: np.ndarray) -> bytes:
    """Return the encoded chunk of one sample of an array."""
    settings = packing(array)
    return encode_chunk(values) if settings is None else _packed(_turned(array, values), settings)


def decode_sample(array: ArrayLayout, chunk: bytes, out: np.ndarray) -> None:
    """Decode the chunk of one sample of an array into all of `out`; raise CorruptChunkError."""
    if packing(array) is None:
        decode_chunk(chunk, out)
    else:
        _unpack(chunk, _turned(array, out))


def _turned(array: ArrayLayout, values: np.ndarray) -> np.ndarray:
    """Return a view of one sample's values with the axes in the order of its chunk."""
    turned: np.ndarray = values[None].transpose(axes_order(array))[0]
    return turned


def axes_order(array: ArrayLayout) -> tuple[int, ...] | None:
    """Return the order of the axes (sample, ...) of an array in its chunks; None keeps it.

    The axes of a trajectory (frames, ..., k) are reversed, so that the values of one coordinate
    over time are neighbours, and bytes of one significance are put together: float32 positions then
    take half the space of a plain chunk.
    """
    if array.is_clip:
        return (0, *(1 + axis for axis in _CLIP_ORDER))
    return (0, *range(len(array.shape), 0, -1)) if array.is_trajectory else None


def in_order_of_chunks(array: ArrayLayout, values: np.ndarray) -> bool:
    """Return whether samples (samples, *sample shape) lie in memory in the order of chunks."""
    return bool(
        (values.transpose(axes_order(array)) if array.is_clip else values).flags.c_contiguous
    )


def empty_in_order(array: ArrayLayout, count: int) -> np.ndarray:
    """Return an empty array (count, *sample shape) that clips are decoded into without a copy."""
    shape = (count, *array.shape)
    if not array.is_clip:
        return np.empty(shape, dtype=array.dtype)
    order = axes_order(array)
    assert order is not None
    return np.empty([shape[axis] for axis in order], dtype=array.dtype).transpose(np.argsort(order))


def packing(array: ArrayLayout) -> Packing | None:
    """Return blosc's settings for the chunks of an array; None: they are coded with zstd alone."""
    if array.is_clip:
        return CLIP
    return TRAJECTORY if array.is_trajectory else None


def check_chunk(chunk: bytes) -> None:
    """Raise CorruptChunkError if the checksum of an encoded chunk does not hold.

    Nothing is decoded.
    """
    _without_crc(chunk, "chunk")


def encode_shard(chunks: Sequence[bytes | None]) -> bytes:
    """Return the shard of encoded `chunks` in C order of the chunk grid.

    None is a chunk that is missing.
    """
    index = np.full((len(chunks), 2), MISSING, dtype="<u8")
    offset = 0
    for position, chunk in enumerate(chunks):
        if chunk is not None:
            index[position] = (offset, len(chunk))
            offset += len(chunk)
    return b"".join(chunk for chunk in chunks if chunk is not None) + _with_crc(index.tobytes())


def shard_index_size(chunk_count: int) -> int:
    """Return the size in bytes of the index at a shard's end."""
    return 16 * chunk_count + _CRC_BYTES


def decode_shard_index(data: bytes, chunk_count: int) -> np.ndarray:
    """Return the index, (chunk_count, 2) uint64 of offset and length, from a shard's last bytes."""
    index = _without_crc(data[-shard_index_size(chunk_count) :], "shard index")
    return np.frombuffer(index, dtype="<u8").reshape(chunk_count, 2)


def _packed(data: np.ndarray, packing: Packing) -> bytes:
    ordered = np.ascontiguousarray(data).astype(data.dtype.newbyteorder("<"), copy=False)
    # blosc copies memory as it is, so it must have the order of the chunk first.
    shuffle = {"noshuffle": blosc.NOSHUFFLE, "shuffle": blosc.SHUFFLE}[packing.shuffle]
    return _with_crc(bytes(blosc.Blosc(packing.cname, packing.clevel, shuffle).encode(ordered)))


def _unpack(chunk: bytes, out: np.ndarray) -> None:
    """Decode a chunk of blosc into all of `out`; raise CorruptChunkError."""
    frame = _without_crc(chunk, "chunk")
    size = int.from_bytes(frame[4:8], "little")  # of blosc's header
    if len(frame) < 16 or size != out.nbytes:
        raise CorruptChunkError(f"the chunk decodes to {size} bytes, and {out.nbytes} are expected")
    # In the order of the chunk, nothing has to be copied.
    if out.flags.c_contiguous:
        blosc.decompress(frame, out)
        return
    # Otherwise decode into a buffer of this thread, and copy into the order of `out`.
    ordered = getattr(_scratch, "ordered", None)
    if ordered is None or ordered.shape != out.shape or ordered.dtype != out.dtype:
        ordered = _scratch.ordered = np.empty(out.shape, dtype=out.dtype)
    blosc.decompress(frame, ordered)
    out[...] = ordered


def _with_crc(data: bytes) -> bytes:
    return data + int(google_crc32c.value(data)).to_bytes(_CRC_BYTES, "little")


def _without_crc(data: bytes, part: str) -> memoryview:
    """Return the bytes before the checksum, without a copy of them."""
    # The checksum of data and its own checksum is a constant: one pass, and no copy.
    if len(data) < _CRC_BYTES or google_crc32c.value(data) != _RESIDUE:
        raise CorruptChunkError(f"the crc32c of the {part} does not hold")
    return memoryview(data)[:-_CRC_BYTES]


def _content_size(frame: memoryview) -> int | None:
    """Return the decoded size that a zstd frame states, or None [RFC 8878, 3.1.1.1]."""
    if len(frame) < 6 or bytes(frame[:4]) != b"\x28\xb5\x2f\xfd":
        return None
    # Byte 4 says how many bytes the window, the dictionary and the size of the content have.
    descriptor = frame[4]
    single_segment = descriptor >> 5 & 1
    width = (single_segment, 2, 4, 8)[descriptor >> 6]
    start = 5 + (1 - single_segment) + (0, 1, 2, 4)[descriptor & 3]
    if width == 0 or len(frame) < start + width:
        return None
    # A size of two bytes is stored less 256, for one byte holds all smaller ones.
    return int.from_bytes(frame[start : start + width], "little") + (256 if width == 2 else 0)
