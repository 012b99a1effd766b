"""What Cycles computes on: the CPU, or a GPU that the environment variable STICKSLIP_RENDER_DEVICE asks for.

Pictures of a GPU differ from those of the CPU in their noise, and those of another GPU or driver may do. So the device
is in the build of the renderer, and workers of different devices share no results.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from stickslip_blender.blender import import_bpy

VARIABLE = "STICKSLIP_RENDER_DEVICE"
CPU = "cpu"
DEVICES = (CPU, "optix", "cuda", "hip", "oneapi", "metal")

_NVIDIA_DRIVER = Path("/proc/driver/nvidia/version")


class NoDeviceError(RuntimeError):
    """A device was asked for that there is none of."""


def device() -> str:
    """Return the device that is asked for, one of `DEVICES`; raise NoDeviceError."""
    name = os.environ.get(VARIABLE) or CPU
    if name not in DEVICES:
        raise NoDeviceError(f"{VARIABLE} must be one of {', '.join(DEVICES)}; got {name!r}")
    return name


def use_device(scene: Any) -> None:
    """Let Cycles compute on the device that is asked for; raise NoDeviceError where Cycles finds none.

    To be called after factory settings were read: they forget the devices.
    """
    if device() != CPU:
        _found()
    scene.cycles.device = "CPU" if device() == CPU else "GPU"


def described() -> dict[str, Any]:
    """Return what decides on the pixels: the device, and of GPUs their names and the driver's major version."""
    if device() == CPU:
        return {"device": CPU}
    return {"device": device(), "names": sorted({found.name for found in _found()}), "driver": _driver()}


def _found() -> list[Any]:
    """Return Cycles' devices of the sort that is asked for, and switch them on and all others off."""
    preferences = import_bpy().context.preferences.addons["cycles"].preferences
    sort = device().upper()
    try:
        preferences.compute_device_type = sort
    except TypeError as error:  # of an enumeration that does not have it
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
    """Return the class of the GPU's driver: its major version, where the system says it."""
    try:
        words = _NVIDIA_DRIVER.read_text(encoding="utf-8").split()
    except OSError:
        return "unknown"
    return next((word.partition(".")[0] for word in words if word[0].isdigit()), "unknown")
