"""Hostile files: each is refused from its headers, within limits of time and memory."""

import io
import struct
import time
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable

import numpy as np
import pytest
from stickslip_schemas.scene.document import MAX_VERTICES
from stickslip_schemas.scene.errors import UnfitFileError
from stickslip_schemas.scene.gate import (
    MAX_FILE_BYTES,
    MAX_SOUP_VERTICES,
    MAX_TRIANGLES,
    check_file,
)

SECONDS = 2.0
"""CPU time to refuse a file [s]."""
MEMORY = 64 * 2**20
"""Memory to refuse a file of at most 16 MiB [bytes]."""

HEADER = "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3), }"


def array(header: str = HEADER, values: bytes = bytes(48)) -> bytes:
    """An array in NumPy's format with any header."""
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + values


def npz(
    content: bytes | None = None,
    *,
    name: str = "positions.npy",
    compression: int = zipfile.ZIP_DEFLATED,
) -> bytes:
    """An archive with one member."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        archive.writestr(name, array() if content is None else content)
    return file.getvalue()


def shaped(shape: str) -> bytes:
    return npz(array(HEADER.replace("(2, 3)", shape)))


def typed(name: str) -> bytes:
    return npz(array(HEADER.replace("<f8", name)))


def patched(data: bytes, offset: int, value: int) -> bytes:
    """An archive whose only member has another 16-bit field, in its directory and before itself."""
    changed = bytearray(data)
    struct.pack_into("<H", changed, offset - 2, value)
    struct.pack_into("<H", changed, data.index(b"PK\x01\x02") + offset, value)
    return bytes(changed)


def many_members(count: int) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for number in range(count):
            archive.writestr(f"{number}.npy", b"")
    return file.getvalue()


def lying_size() -> bytes:
    """The directory says 100 bytes; the stream unpacks to a gigabyte."""
    data = bytearray(npz(bytes(10**6)))
    struct.pack_into("<L", data, data.index(b"PK\x01\x02") + 24, 100)
    return bytes(data)


def broken_stream() -> bytes:
    data = bytearray(npz())
    data[45:55] = b"\xff" * 10
    return bytes(data)


NPZ: dict[str, Callable[[], bytes]] = {
    "80 GB": lambda: shaped("(10000000000,)"),
    "10^30": lambda: shaped("(" + "1" + "0" * 30 + ",)"),
    "many sides": lambda: shaped("(" + "2, " * 60 + ")"),
    "negative side": lambda: shaped("(-2, 3)"),
    "bool side": lambda: shaped("(True, 3)"),
    "side of text": lambda: shaped("('2', 3)"),
    "no tuple": lambda: shaped("[2, 3]"),
    "deep header": lambda: npz(array("(" * 900)),
    "long header": lambda: npz(array(" " * 60_000)),
    "header is no Python": lambda: npz(array("{'descr': import os}")),
    "header of fewer fields": lambda: npz(array("{'descr': '<f8'}")),
    "header cut": lambda: npz(array()[:12]),
    "objects": lambda: typed("|O"),
    "structures": lambda: npz(array(HEADER.replace("'<f8'", "[('a', '<f8')]"))),
    "booleans": lambda: typed("|b1"),
    "complex numbers": lambda: typed("<c16"),
    "times": lambda: typed("<M8[ns]"),
    "text": lambda: typed("<U8"),
    "fewer values": lambda: npz(array(values=b"")),
    "more values": lambda: npz(array(values=bytes(4800))),
    "no array inside": lambda: npz(name="read.me"),
    "another file beside": lambda: npz(name="positions.txt"),
    "arrays of no use": lambda: npz(name="speed.npy"),
    "path in a name": lambda: npz(name="../positions.npy"),
    "not NumPy's format": lambda: npz(b"positions"),
    "empty member": lambda: npz(b""),
    "300 MB of zeros": lambda: npz(bytes(3 * 10**8)),
    "100 MB of zeros": lambda: npz(array(values=bytes(10**8))),
    "encrypted": lambda: patched(npz(), 8, 1),
    "unknown compression": lambda: patched(npz(), 10, 77),
    "bzip2": lambda: npz(compression=zipfile.ZIP_BZIP2),
    "LZMA": lambda: npz(compression=zipfile.ZIP_LZMA),
    "17 arrays": lambda: many_members(17),
    "100,000 arrays": lambda: many_members(70_000),
    "size that lies": lying_size,
    "broken stream": broken_stream,
    "cut": lambda: npz()[:-30],
    "only a magic number": lambda: b"PK\x03\x04",
    "directory that lies": lambda: (
        npz()[:-22] + struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 1, 1, 2**32 - 1, 0, 0)
    ),
    "directory elsewhere": lambda: (
        npz()[:-22] + struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 1, 1, 59, 2**31, 0)
    ),
}

TEXT: dict[str, Callable[[], bytes]] = {
    "two million faces": lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + b"f 1 2 3\n" * 2_000_000,
    "a face of 8 million corners": lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf" + b" 1" * 8_000_000,
    "that face in many lines": lambda: b"v 0 0 0\nf" + b" 1 2 3 \\\n" * 1_500_000,
    "many faces of many corners": lambda: b"v 0 0 0\n" + (b"f" + b" 1" * 20_000 + b"\n") * 300,
    "many vertices": lambda: b"v 0 0 0\n" * (MAX_SOUP_VERTICES + 1),
    "empty lines": lambda: b"\n" * MAX_FILE_BYTES,
    "vertical tabs": lambda: b"\x0b" * MAX_FILE_BYTES,
    "line separators": lambda: "\u2028".encode() * (MAX_FILE_BYTES // 3),
    "comments": lambda: b"#\r\n" * 5_000_000,
    "rows of a path": lambda: b"time,x,y,z,rx,ry,rz\n" + b"0,0,0,0,0,0,0\n" * 1_100_000,
    "too large": lambda: bytes(MAX_FILE_BYTES + 1),
}


@pytest.mark.parametrize("name", [*NPZ, *TEXT])
def test_a_hostile_file_is_refused_at_once(name: str) -> None:
    data = (NPZ | TEXT)[name]()
    began_at = time.process_time()
    with pytest.raises(UnfitFileError, match="must"):
        check_file(data)
    assert time.process_time() - began_at < SECONDS
    tracemalloc.start()
    with pytest.raises(UnfitFileError):
        check_file(data)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < MEMORY


def test_a_comment_behind_a_face_has_no_corners() -> None:
    vertices = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    check_file(vertices + b"f 1 2 3 # of the left sleeve\n" * (MAX_TRIANGLES // 4))


def test_files_at_the_limits_pass() -> None:
    vertices = b"v 0.123456789 0.123456789 0.123456789\n" * MAX_VERTICES
    check_file(vertices + b"f 1 2 3\n" * MAX_TRIANGLES)
    check_file(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 4 \\\n 3\n")
    check_file(b"time,x,y,z,rx,ry,rz\n" + b"0,0,0,0,0,0,0\n" * 100_000)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("numbers", ["<f4", "<f8", ">f8", "<i4", "<i8", "|u1"])
def test_what_numpy_saves_passes(save: Callable[..., None], numbers: str) -> None:
    values = np.zeros((4, 3), numbers)
    for arrays in (
        {"positions": values},
        {"positions": values[None], "triangles": values, "times": values[0, :1]},
        {"rest": values, "weights": values, "bones": values, "triangles": values, "times": values},
        {"time": values[:, 0], "move": values, "turn": np.asfortranarray(values)},
    ):
        file = io.BytesIO()
        save(file, **arrays)
        check_file(file.getvalue())


def test_a_member_that_is_compressed_well_is_not_unpacked() -> None:
    """Reading the header of a member decompresses its beginning only."""
    data = npz(array(HEADER.replace("(2, 3)", "(2000000,)"), bytes(16_000_000)))
    assert len(zlib.compress(bytes(10))) < len(data) < 10**5
    tracemalloc.start()
    check_file(data)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**20
