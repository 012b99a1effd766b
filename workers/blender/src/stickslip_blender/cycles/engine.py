"""Blender: its import, the device of Cycles, and settings that all scenes share.

The environment variable STICKSLIP_RENDER_DEVICE names the device; the default is the CPU. Noise
differs between the CPU and a GPU, and it may differ between GPUs and drivers. The device is
therefore part of the renderer's build, and workers with different devices share no results. All
scenes have one thread and a fixed seed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from stickslip_schemas.installation import install_hint
from stickslip_schemas.spec.jobs import Quality

# Debian's names
SYSTEM_LIBRARIES = (
    "libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 libxext6 libxcb1 libgl1"
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
            "bpy is missing: stickslip_blender runs in an environment of its own: "
            + install_hint("stickslip-blender", "bpy")
        ) from error
    except ImportError as error:
        raise ImportError(
            f"{error}; on a bare Debian bpy needs: apt-get install {SYSTEM_LIBRARIES}"
        ) from error
    return bpy


@contextmanager
def _one_processor() -> Iterator[None]:
    """Show one processor to Blender's task scheduler while it starts.

    So it makes no worker threads.

    Each process renders with one thread. Idle TBB workers spin: each used half a core while nothing
    was rendered.
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
    """Return what the pixels depend on: the device and, for GPUs, names and driver.

    Only the driver's major version counts.
    """
    if device() == CPU:
        return {"device": CPU}
    return {
        "device": device(),
        "names": sorted({found.name for found in _find_devices()}),
        "driver": _driver(),
    }


def _find_devices() -> list[Any]:
    """Return Cycles' devices of the requested type; enable them and disable all others."""
    preferences = import_bpy().context.preferences.addons["cycles"].preferences
    sort = device().upper()
    try:
        preferences.compute_device_type = sort
    except TypeError as error:  # the enumeration lacks it
        raise NoDeviceError(
            f"{VARIABLE} is {device()!r}, and this Blender cannot use such devices: {error}"
        ) from error
    preferences.refresh_devices()
    for each in preferences.devices:
        each.use = each.type == sort
    found = [each for each in preferences.devices if each.type == sort]
    if not found:
        raise NoDeviceError(
            f"{VARIABLE} is {device()!r}, and Cycles finds no such device here: install its "
            f"driver, or unset {VARIABLE}"
        )
    return found


def _driver() -> str:
    """Return the major version of the GPU driver, or `unknown`."""
    try:
        words = _NVIDIA_DRIVER.read_text(encoding="utf-8").split()
    except OSError:
        return "unknown"
    return next((word.partition(".")[0] for word in words if word[0].isdigit()), "unknown")


@dataclass(frozen=True)
class Sampling:
    """What a quality means to Cycles."""

    samples: int
    """Paths per pixel."""
    denoiser: Literal["none", "quick", "plain", "guided"] = "none"
    """OpenImageDenoise; `guided` by albedo and normal, for textures have edges; `quick`: its
    smallest network.

    Guides are those of what a smooth floor mirrors, as noisy as the gloss itself: light of an even
    cloth is `plain`.
    """
    seed: int = 0
    """Of the sampling noise, the same for every frame: the remaining noise does not flicker, and
    clips compress.
    """
    skipped: int = 0
    """Paths per pixel that are left out first. Cycles sends the very first one through the middle
    of the pixel.
    """


@dataclass(frozen=True)
class ClothSampling:
    """What a quality means to a clip of cloth, whose light is denoised."""

    frame: int
    """Paths per pixel in the whole frame."""
    window: int
    """Paths in the window that the cloth is in, per pixel of its shading: FINE x FINE for one of a
    picture.
    """
    floors: tuple[float, float, float]
    """Least PSNR of a clip over the cloth, its landed part and its edge [dB]."""

    def over(self, area: float) -> ClothSampling:
        """Trace more paths for the same cost if the window has a smaller area [px^2]."""
        return replace(
            self,
            window=round(self.window * min(max(_FULL_AREA / max(area, 1.0), 1.0), _MAX_PATH_RATIO)),
        )

    @property
    def finer(self) -> ClothSampling:
        """Half the noise: for a clip that is below its floors."""
        return replace(self, frame=4 * self.frame, window=4 * self.window)


_FULL_AREA = 13_000.0  # of a window from which on the paths of the quality suffice [px^2]
_MAX_PATH_RATIO = 1.6  # most times as many paths in a smaller window

# Frozen: a change makes other pictures and another build digest. benchmarks/render_rods.py measures
# them.
SAMPLING = {
    Quality.preview: Sampling(samples=4),
    Quality.draft: Sampling(samples=8),
    Quality.standard: Sampling(samples=28),
    Quality.high: Sampling(samples=128),
}
# The same for cloth, whose clips are thirty frames: benchmarks/render_cloth.py measures them.
CLOTH_SAMPLING = {
    Quality.preview: ClothSampling(1, 1, (24.0, 20.0, 21.0)),
    Quality.draft: ClothSampling(1, 3, (30.0, 27.0, 25.0)),
    Quality.standard: ClothSampling(1, 5, (34.0, 30.0, 28.0)),
    Quality.high: ClothSampling(8, 32, (35.0, 31.0, 29.0)),
}


def new_scene(*, max_bounces: int = 2, diffuse_bounces: int = 1, light_tree: bool = True) -> Any:
    """Empty Blender and return its one scene, with the engine set up and a world.

    Blender holds one scene per process: a second one in the same process would empty the first.
    """
    bpy = import_bpy()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    # Blender makes a directory for itself, which is never used, and a killed process leaves it
    # behind.
    with suppress(OSError):
        Path(bpy.app.tempdir).rmdir()
    scene = bpy.context.scene
    render = scene.render
    cycles = scene.cycles
    render.engine = "CYCLES"
    # One thread: workers run several renderers beside each other, and bytes never depend on
    # their number.
    render.threads_mode = "FIXED"
    render.threads = 1
    render.use_persistent_data = True
    render.use_compositing = False
    render.use_sequencer = False
    render.resolution_percentage = 100
    use_device(scene)
    # The same number of paths for every pixel, and no limit of time: no pixel depends on the
    # machine's load.
    cycles.use_animated_seed = False
    cycles.use_adaptive_sampling = False
    cycles.time_limit = 0.0
    cycles.pixel_filter_type = "BOX"  # a pixel is the mean over its own area, as on a sensor
    cycles.caustics_reflective = False
    cycles.caustics_refractive = False
    cycles.max_bounces = max_bounces
    cycles.diffuse_bounces = diffuse_bounces
    cycles.glossy_bounces = 1
    cycles.use_light_tree = light_tree

    # 8-bit values are the sRGB encoding of the light itself, without filmic curve or dither: colors
    # keep meaning.
    scene.display_settings.display_device = "sRGB"
    view = scene.view_settings
    view.view_transform = "Standard"
    view.look = "None"
    view.exposure = 0.0
    view.gamma = 1.0
    render.dither_intensity = 0.0
    scene.world = bpy.data.worlds.new("world")
    return scene


def set_sampling(scene: Any, sampling: Sampling) -> None:
    """Set the samples of the scene's pixels."""
    cycles = scene.cycles
    cycles.samples = sampling.skipped + sampling.samples
    cycles.use_sample_subset = sampling.skipped > 0
    cycles.sample_offset = sampling.skipped
    cycles.sample_subset_length = sampling.samples
    cycles.seed = sampling.seed
    cycles.use_denoising = sampling.denoiser != "none"
    if sampling.denoiser != "none":
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.denoising_quality = "FAST" if sampling.denoiser == "quick" else "HIGH"
        cycles.denoising_prefilter = "NONE"
        cycles.denoising_input_passes = (
            "RGB_ALBEDO_NORMAL" if sampling.denoiser == "guided" else "RGB"
        )
        cycles.denoising_use_gpu = device() != CPU
