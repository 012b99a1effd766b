"""Get a rendered frame out of Blender as linear light.

Headless Blender does not give its pixels away in memory, so a frame goes through an uncompressed file: on Linux one
that has no name and lies in memory, so that a killed process leaves nothing behind.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

from stickslip_blender.blender import import_bpy
from stickslip_blender.exr import read_exr


@dataclass(frozen=True)
class Window:
    """A part of a frame: columns [left, right), rows [top, bottom) [px], row 0 on top."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def is_empty(self) -> bool:
        """True where there is no pixel in it."""
        return self.right <= self.left or self.bottom <= self.top

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the window in a frame (height, width, ...)."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def place(self) -> tuple[int, int, int, int]:
        """Left, top, width and height, as the compiled rasteriser takes them."""
        return self.left, self.top, self.right - self.left, self.bottom - self.top


class FrameReader:
    """Renders a scene into arrays. With a scratch folder given, frames go through a file there instead of memory."""

    def __init__(self, scene: Any, scratch: str | Path | None = None) -> None:
        self._memory: int | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        if scratch is None and hasattr(os, "memfd_create"):
            self._memory = os.memfd_create("frame")
            self._path = Path(f"/proc/self/fd/{self._memory}")
        else:
            self._folder = tempfile.TemporaryDirectory(prefix="stickslip-frames-", dir=scratch)
            self._path = Path(self._folder.name) / "frame"
        self._scene = scene
        image, render = scene.render.image_settings, scene.render
        image.color_management = "FOLLOW_SCENE"
        image.file_format = "OPEN_EXR"
        image.color_depth = "16"
        image.exr_codec = "NONE"
        render.use_stamp = False
        render.use_file_extension = False
        render.filepath = str(self._path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file."""
        if self._folder is not None:
            self._folder.cleanup()
        if self._memory is not None:
            os.close(self._memory)
        self._memory = self._folder = None

    def read_light(self, window: Window | None = None) -> npt.NDArray[np.float16]:
        """Render the scene as it stands, or a window of it: linear light, not clipped, shape (height, width, 3).

        A window has the very values that it would have in the whole frame.
        """
        return read_exr(self._rendered("RGB", window), "RGB")

    def read_matte(self, window: Window | None = None) -> npt.NDArray[np.float16]:
        """Render as `read_light` does, before nothing: light times coverage, and coverage, shape (height, width, 4)."""
        return read_exr(self._rendered("RGBA", window), "RGBA")

    def _rendered(self, channels: Literal["RGB", "RGBA"], window: Window | None) -> bytes:
        self._scene.render.film_transparent = channels == "RGBA"
        self._scene.render.image_settings.color_mode = channels
        _set_window(self._scene.render, window)
        self._path.write_bytes(b"")  # so that a frame is never an old one
        with _quiet():
            import_bpy().ops.render.render(write_still=True)
        return self._path.read_bytes()


def _set_window(render: Any, window: Window | None) -> None:
    render.use_border = render.use_crop_to_border = window is not None
    if window is not None:
        width, height = render.resolution_x, render.resolution_y
        # Blender truncates to whole pixels: half a pixel keeps rounding out of it. It counts rows from below.
        render.border_min_x = (window.left + 0.5) / width
        render.border_max_x = (window.right + 0.5) / width
        render.border_min_y = (height - window.bottom + 0.5) / height
        render.border_max_y = (height - window.top + 0.5) / height


@contextmanager
def _quiet() -> Iterator[None]:
    """Send file descriptor 1 nowhere: Blender logs every saved frame there and, as a module, has no switch for it."""
    sys.stdout.flush()
    stdout, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(stdout, 1)
        os.close(stdout)
        os.close(nowhere)
