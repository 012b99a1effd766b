"""Import Blender, and choose the device that Cycles computes on.

The environment variable STICKSLIP_RENDER_DEVICE names the device; the default is the CPU. Noise differs between the CPU
and a GPU, and it may differ between GPUs and drivers. The device is therefore part of the renderer's build, and workers
with different devices share no results.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

SYSTEM_LIBRARIES = (
    "libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 libxext6 libxcb1 libgl1"  # Debian's names
)
VARIABLE = "STICKSLIP_RENDER_DEVICE"
CPU = "cpu"
DEVICES = (CPU, "optix", "cuda", "hip", "oneapi", "metal")

_NVIDIA_DRIVER = Path("/proc/driver/nvidia/version")


class NoDeviceError(RuntimeError):
    """The requested render device is not available."""


def import_bpy() -> Any:
    """Return the bpy module; an ImportError names what is missing."""
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
    """Show one processor to Blender's task scheduler while it starts, so that it makes no worker threads.

    Each process renders with one thread. Idle TBB workers spin: each used half a core while nothing was rendered.
    """
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def blender_version() -> dict[str, str]:
    """Return the version of the bpy module and the hash of the sources that it was built from."""
    app = import_bpy().app
    return {"bpy": app.version_string, "blender_build": app.build_hash.decode()}


def device() -> str:
    """Return the requested device, one of `DEVICES`; raise NoDeviceError for another name."""
    name = os.environ.get(VARIABLE) or CPU
    if name not in DEVICES:
        raise NoDeviceError(f"{VARIABLE} must be one of {', '.join(DEVICES)}; got {name!r}")
    return name


def use_device(scene: Any) -> None:
    """Render a scene on the requested device; raise NoDeviceError where Cycles finds none.

    Call it after reading factory settings, which reset the devices.
    """
    if device() != CPU:
        _find_devices()
    scene.cycles.device = "CPU" if device() == CPU else "GPU"


def described() -> dict[str, Any]:
    """Return what the pixels depend on: the device and, for GPUs, their names and the driver's major version."""
    if device() == CPU:
        return {"device": CPU}
    return {"device": device(), "names": sorted({found.name for found in _find_devices()}), "driver": _driver()}


def _find_devices() -> list[Any]:
    """Return Cycles' devices of the requested type; enable them and disable all others."""
    preferences = import_bpy().context.preferences.addons["cycles"].preferences
    sort = device().upper()
    try:
        preferences.compute_device_type = sort
    except TypeError as error:  # the enumeration lacks it
        raise NoDeviceError(f"{VARIABLE} is {device()!r}, and this Blender cannot use such devices: {error}") from error
    preferences.refresh_devices()
    for each in preferences.devices:
        each.use = each.type == sort
    found = [each for each in preferences.devices if each.type == sort]
    if not found:
        raise NoDeviceError(
            f"{VARIABLE} is {device()!r}, and Cycles finds no such device here: install its driver, or unset {VARIABLE}"
        )
    return found


def _driver() -> str:
    """Return the major version of the GPU driver, or `unknown`."""
    try:
        words = _NVIDIA_DRIVER.read_text(encoding="utf-8").split()
    except OSError:
        return "unknown"
    return next((word.partition(".")[0] for word in words if word[0].isdigit()), "unknown")
