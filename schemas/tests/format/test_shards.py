"""Chunks and shards: what is written is read, and no flipped bit goes unseen."""

import numpy as np
import pytest
from stickslip_schemas.format.codecs import (
    MISSING,
    CorruptChunkError,
    decode_chunk,
    decode_sample,
    decode_shard_index,
    encode_chunk,
    encode_sample,
    encode_shard,
    shard_index_size,
)
from stickslip_schemas.spec.arrays import ArrayLayout

TRAJECTORY = ArrayLayout(
    "positions", "float32", (100, 500, 3), ("t", "vertex", "xyz"), "", is_trajectory=True
)


def test_chunk_round_trip() -> None:
    data = np.random.default_rng(0).integers(0, 4, (4, 32, 32, 3), dtype=np.uint8)
    out = np.empty_like(data)
    decode_chunk(encode_chunk(data), out)
    assert np.array_equal(out, data)
    assert bytes(decode_chunk(encode_chunk(data.tobytes()))) == data.tobytes()


def test_no_flipped_bit_goes_unseen() -> None:
    rng = np.random.default_rng(1)
    chunk = encode_chunk(rng.integers(0, 4, 5000, dtype=np.uint8))
    for bit in rng.choice(8 * len(chunk), 500, replace=False):
        flipped = bytearray(chunk)
        flipped[bit // 8] ^= 1 << (bit % 8)
        with pytest.raises(CorruptChunkError):
            decode_chunk(bytes(flipped))


@pytest.mark.parametrize("size", [1, 255, 256, 5000, 70_000])
def test_a_chunk_of_another_size_is_refused(size: int) -> None:
    chunk = encode_chunk(np.zeros(size, dtype=np.uint8))
    decode_chunk(chunk, np.empty(size, dtype=np.uint8))
    for wrong in (size - 1, size + 1):
        with pytest.raises(
            CorruptChunkError, match=f"decodes to {size} bytes, and {wrong} are expected"
        ):
            decode_chunk(chunk, np.empty(wrong, dtype=np.uint8))


def smooth_trajectory() -> np.ndarray:
    """Return vertices that sway, (100, 500, 3) float32."""
    t, phase = np.linspace(0.0, 6.0, 100), np.random.default_rng(2).random((500, 3))
    return (0.1 * np.sin(t[:, None, None] + 6.0 * phase)).astype(np.float32)


def test_trajectory_round_trip() -> None:
    data = smooth_trajectory()
    chunk = encode_sample(TRAJECTORY, data)
    assert chunk == encode_sample(TRAJECTORY, np.asfortranarray(data))
    assert len(chunk) < 0.8 * len(encode_chunk(data))
    out = np.empty_like(data)
    decode_sample(TRAJECTORY, chunk, out)
    assert np.array_equal(out, data)


def test_a_broken_trajectory_is_refused() -> None:
    data = smooth_trajectory()
    chunk = bytearray(encode_sample(TRAJECTORY, data))
    with pytest.raises(CorruptChunkError, match="decodes to 600000 bytes, and 594000 are expected"):
        decode_sample(TRAJECTORY, bytes(chunk), np.empty((99, 500, 3), dtype=np.float32))
    chunk[1000] ^= 1
    with pytest.raises(CorruptChunkError, match="crc32c of the chunk"):
        decode_sample(TRAJECTORY, bytes(chunk), np.empty_like(data))


def test_shard_index_points_at_the_chunks() -> None:
    chunks = [b"one", None, b"three"]
    shard = encode_shard(chunks)
    index = decode_shard_index(shard[-shard_index_size(3) :], 3)
    for (offset, length), chunk in zip(index, chunks, strict=True):
        if chunk is None:
            assert (offset, length) == (MISSING, MISSING)
        else:
            assert shard[int(offset) : int(offset + length)] == chunk


def test_a_broken_index_is_refused() -> None:
    shard = bytearray(encode_shard([b"one"]))
    shard[-6] ^= 1
    with pytest.raises(CorruptChunkError, match="shard index"):
        decode_shard_index(bytes(shard), 1)
