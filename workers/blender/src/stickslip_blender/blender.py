"""Import Blender, or say what is missing."""

from __future__ import annotations

from typing import Any

SYSTEM_LIBRARIES = (
    "libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 libxext6 libxcb1 libgl1"  # Debian's names
)


def import_bpy() -> Any:
    """Return the bpy module."""
    try:
        import bpy
    except ModuleNotFoundError as error:
        raise ImportError(
            "bpy is missing: stickslip_blender runs in an environment of its own (pip install stickslip-blender)"
        ) from error
    except ImportError as error:
        raise ImportError(f"{error}; on a bare Debian bpy needs: apt-get install {SYSTEM_LIBRARIES}") from error
    return bpy
