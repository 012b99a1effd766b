"""Import Blender, or say what is missing."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SYSTEM_LIBRARIES = (
    "libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 libxext6 libxcb1 libgl1"  # Debian's names
)


def import_bpy() -> Any:
    """Return the bpy module."""
    if "bpy" in sys.modules:
        return sys.modules["bpy"]
    try:
        with _one_processor():
            import bpy
    except ModuleNotFoundError as error:
        raise ImportError(
            "bpy is missing: stickslip_blender runs in an environment of its own (pip install stickslip-blender)"
        ) from error
    except ImportError as error:
        raise ImportError(f"{error}; on a bare Debian bpy needs: apt-get install {SYSTEM_LIBRARIES}") from error
    return bpy


@contextmanager
def _one_processor() -> Iterator[None]:
    """Let Blender's task scheduler, when it starts, see one processor and make no worker threads.

    We render with one thread a process, and idle workers of TBB spin: each ate half a core while nothing was rendered.
    """
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)
