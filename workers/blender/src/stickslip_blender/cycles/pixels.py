"""Read rendered frames from Blender as linear light, and encode light as sRGB.

Headless Blender gives no access to its pixels in memory, so a frame goes through an uncompressed
file. The file is an anonymous one in memory, so a killed process leaves nothing behind.
"""

import faulthandler
import os
import struct
import sys
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from stickslip_blender.cycles.engine import import_bpy
from stickslip_blender.raster import Window

_MAGIC = 20000630
_MULTI_PART_OR_DEEP_OR_TILED = 0x1A00
_HALF = 1


def read_exr(data: bytes, wanted: str) -> npt.NDArray[np.float16]:
    """Return the wanted channels of a frame, linear light, (height, width, channels).

    Row 0 is on top.

    The function reads only one kind of OpenEXR file: scan lines of half floats, not compressed.
    Blender writes this kind here. The file has these parts [OpenEXR, File Layout]:

    - a magic number and version
    - attributes (name, type, size, value) up to an empty name
    - offsets of the lines
    - the lines, each with its row, its size in bytes and its channels in alphabetical order
    """
    magic, version = struct.unpack_from("<ii", data)
    if magic != _MAGIC or version & _MULTI_PART_OR_DEEP_OR_TILED:
        raise ValueError("the frame must be an OpenEXR file of scan lines in one part")
    header, at = _attributes(data)
    channels = _channels(header["channels"])
    left, top, right, bottom = struct.unpack("<4i", header["dataWindow"])
    if header["compression"] != b"\0" or [name for name, kind in channels if kind != _HALF]:
        raise ValueError("the frame must be of half floats that are not compressed")
    width = right - left + 1
    height = bottom - top + 1
    line = np.dtype([("row", "<i4"), ("size", "<i4"), ("values", "<f2", (len(channels), width))])
    first = int(
        struct.unpack_from("<Q", data, at)[0]
    )  # lines follow one another in increasing order
    lines = np.frombuffer(data, dtype=line, count=height, offset=first)
    names = [name for name, _ in channels]
    return np.stack([lines["values"][:, names.index(name)] for name in wanted], axis=-1).astype(
        np.float16, copy=False
    )


def _attributes(data: bytes) -> tuple[dict[str, bytes], int]:
    """Return the values of the header's attributes by name, and the end of the header."""
    values: dict[str, bytes] = {}
    at = 8
    while data[at] != 0:
        name, at = _word(data, at)
        _, at = _word(data, at)
        (size,) = struct.unpack_from("<i", data, at)
        values[name] = data[at + 4 : at + 4 + size]
        at += 4 + size
    return values, at + 1


def _channels(data: bytes) -> list[tuple[str, int]]:
    """Return the names and pixel types of a channel list, in the order of the file."""
    channels: list[tuple[str, int]] = []
    at = 0
    while data[at] != 0:
        name, at = _word(data, at)
        channels.append((name, struct.unpack_from("<i", data, at)[0]))
        at += 16  # type, linearity and sampling
    return channels


def _word(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode(), end + 1


FIRST_SECONDS = 300.0  # extra time of a first frame [s]: a GPU may load its kernels
LEAST_SECONDS = 60.0  # extra time of later frames [s], for a machine with much other work
_PATH_SECONDS = 5e-6  # time of a path before the first measurement [s], for a slow core
_SLOWER = 20.0  # a frame hangs if its paths take this many times as long as before

_LEVELS = 65536  # size of the table that encodes linear light
_LIGHT = np.arange(_LEVELS) / (_LEVELS - 1)
_SRGB = np.where(_LIGHT <= 0.0031308, 12.92 * _LIGHT, 1.055 * _LIGHT ** (1.0 / 2.4) - 0.055)
_ENCODED = np.rint(255.0 * _SRGB).astype(np.uint8)


def encode(light: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Return linear light as 8-bit sRGB [IEC 61966-2-1], clipped to [0, 1]."""
    return np.asarray(_ENCODED[(np.clip(light, 0.0, 1.0) * (_LEVELS - 1) + 0.5).astype(np.uint16)])


class FrameReader:
    """Renders a scene into arrays."""

    def __init__(self, scene: Any) -> None:
        memory = os.memfd_create("frame")
        weakref.finalize(self, os.close, memory)
        self._path = Path(f"/proc/self/fd/{memory}")
        self._scene = scene
        image = scene.render.image_settings
        render = scene.render
        image.color_management = "FOLLOW_SCENE"
        image.file_format = "OPEN_EXR"
        image.color_depth = "16"
        image.exr_codec = "NONE"
        render.use_stamp = False
        render.use_file_extension = False
        render.filepath = str(self._path)
        self._besides = FIRST_SECONDS
        self._path_seconds = _PATH_SECONDS

    def read_light(self, window: Window | None = None, fine: int = 1) -> npt.NDArray[np.float16]:
        """Render the scene, or a window of it: linear light (height, width, 3), not clipped.

        A window has exactly the values that it would have in the whole frame. The scene is rendered
        with fine x fine pixels for each pixel.
        """
        return read_exr(self._rendered("RGB", window, fine), "RGB")

    def read_matte(self, window: Window | None = None) -> npt.NDArray[np.float16]:
        """Render as `read_light` does, with a transparent background: (height, width, 4).

        The channels are light times coverage, and coverage.
        """
        return read_exr(self._rendered("RGBA", window), "RGBA")

    def _rendered(
        self, channels: Literal["RGB", "RGBA"], window: Window | None, fine: int = 1
    ) -> bytes:
        self._scene.render.resolution_percentage = 100 * fine
        self._scene.render.film_transparent = channels == "RGBA"
        self._scene.render.image_settings.color_mode = channels
        _set_window(self._scene.render, window, fine)
        self._path.write_bytes(b"")  # an old frame never counts as a new one
        with _quiet(), self._watched(window, fine):
            import_bpy().ops.render.render(write_still=True)
        return self._path.read_bytes()

    @contextmanager
    def _watched(self, window: Window | None, fine: int) -> Iterator[None]:
        """End the process if a frame takes far longer than its paths took in the frames before."""
        render = self._scene.render
        here = window or Window(0, 0, render.resolution_x, render.resolution_y)
        paths = fine**2 * max(here.area, 1) * self._scene.cycles.samples
        start = time.monotonic()
        limit = self._besides + _SLOWER * self._path_seconds * paths
        faulthandler.dump_traceback_later(
            limit, exit=True, file=sys.__stderr__ or 2
        )  # Blender keeps Python's lock
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
        took = (time.monotonic() - start) / paths
        self._path_seconds = (
            took if self._besides == FIRST_SECONDS else max(took, self._path_seconds)
        )
        self._besides = LEAST_SECONDS


def _set_window(render: Any, window: Window | None, fine: int) -> None:
    render.use_border = render.use_crop_to_border = window is not None
    if window is not None:
        width = render.resolution_x
        height = render.resolution_y
        # Blender truncates to whole pixels, so half a pixel keeps rounding out of it. Blender
        # counts rows from below.
        half = 0.5 / fine
        render.border_min_x = (window.left + half) / width
        render.border_max_x = (window.right + half) / width
        render.border_min_y = (height - window.bottom + half) / height
        render.border_max_y = (height - window.top + half) / height


@contextmanager
def _quiet() -> Iterator[None]:
    """Send file descriptor 1 nowhere while Blender saves frames.

    Blender logs every saved frame there and, as a module, has no switch for it.
    """
    sys.stdout.flush()
    stdout = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(stdout, 1)
        os.close(stdout)
        os.close(nowhere)
