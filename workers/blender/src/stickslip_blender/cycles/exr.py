"""Read the one kind of OpenEXR file that we have Blender write: scan lines of half floats, not compressed.

[OpenEXR, File Layout]: a magic number and version; attributes (name, type, size, value) up to an empty name; offsets of
the lines; and the lines, each with its row, its size in bytes and its channels in alphabetical order.
"""

import struct

import numpy as np
import numpy.typing as npt

_MAGIC = 20000630
_MULTI_PART_OR_DEEP_OR_TILED = 0x1A00
_HALF = 1


def read_exr(data: bytes, wanted: str) -> npt.NDArray[np.float16]:
    """Return the wanted channels of an OpenEXR file, linear light, shape (height, width, channels), row 0 on top."""
    magic, version = struct.unpack_from("<ii", data)
    if magic != _MAGIC or version & _MULTI_PART_OR_DEEP_OR_TILED:
        raise ValueError("the frame must be an OpenEXR file of scan lines in one part")
    header, at = _attributes(data)
    channels = _channels(header["channels"])
    left, top, right, bottom = struct.unpack("<4i", header["dataWindow"])
    if header["compression"] != b"\0" or [name for name, kind in channels if kind != _HALF]:
        raise ValueError("the frame must be of half floats that are not compressed")
    width, height = right - left + 1, bottom - top + 1
    line = np.dtype([("row", "<i4"), ("size", "<i4"), ("values", "<f2", (len(channels), width))])
    first = int(struct.unpack_from("<Q", data, at)[0])  # lines follow one another in increasing order
    lines = np.frombuffer(data, dtype=line, count=height, offset=first)
    names = [name for name, _ in channels]
    return np.stack([lines["values"][:, names.index(name)] for name in wanted], axis=-1).astype(np.float16, copy=False)


def _attributes(data: bytes) -> tuple[dict[str, bytes], int]:
    """Return the values of the header's attributes by name, and where the header ends."""
    found: dict[str, bytes] = {}
    at = 8
    while data[at] != 0:
        name, at = _word(data, at)
        _, at = _word(data, at)
        (size,) = struct.unpack_from("<i", data, at)
        found[name] = data[at + 4 : at + 4 + size]
        at += 4 + size
    return found, at + 1


def _channels(data: bytes) -> list[tuple[str, int]]:
    """Return the names and pixel types of a channel list, in the order of the file."""
    found: list[tuple[str, int]] = []
    at = 0
    while data[at] != 0:
        name, at = _word(data, at)
        found.append((name, struct.unpack_from("<i", data, at)[0]))
        at += 16  # type, linearity and sampling
    return found


def _word(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode(), end + 1
