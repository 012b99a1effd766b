"""Blender: its import, the device of Cycles, and settings that all scenes share.

The environment variable STICKSLIP_RENDER_DEVICE names the device. The default is the CPU. Noise
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

# Names of Debian packages
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
    """Return the bpy module.

    If a package or library is missing, an ImportError says how to install it.
    """
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

    The scheduler then makes no worker threads. Each process renders with one thread. Idle TBB
    workers spin: each of them used half a core without any rendering.
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
    """Return the requested device, one of `DEVICES`.

    Raises NoDeviceError for another name.
    """
    name = os.environ.get(VARIABLE) or CPU
    if name not in DEVICES:
        raise NoDeviceError(f"{VARIABLE} must be one of {', '.join(DEVICES)}; got {name!r}")
    return name


def use_device(scene: Any) -> None:
    """Render a scene on the requested device.

    Call it after reading factory settings, because they reset the devices. Raises NoDeviceError if
    Cycles finds no such device.
    """
    if device() != CPU:
        _find_devices()
    scene.cycles.device = "CPU" if device() == CPU else "GPU"


def described() -> dict[str, Any]:
    """Return the device and, for GPUs, the names and the driver, because pixels depend on them.

    Only the driver's major version counts.
    """
    if device() == CPU:
        return {"device": CPU}
    return {
        "device": device(),
        "names": sorted({device.name for device in _find_devices()}),
        "driver": _driver(),
    }


def _find_devices() -> list[Any]:
    """Enable and return Cycles' devices of the requested type, and disable all others."""
    preferences = import_bpy().context.preferences.addons["cycles"].preferences
    sort = device().upper()
    try:
        preferences.compute_device_type = sort
    except TypeError as error:  # the enumeration does not have this type
        raise NoDeviceError(
            f"{VARIABLE} is {device()!r}, and this Blender cannot use such devices: {error}"
        ) from error
    preferences.refresh_devices()
    for each in preferences.devices:
        each.use = each.type == sort
    devices = [each for each in preferences.devices if each.type == sort]
    if not devices:
        raise NoDeviceError(
            f"{VARIABLE} is {device()!r}, and Cycles finds no such device here: install its "
            f"driver, or unset {VARIABLE}"
        )
    return devices


def _driver() -> str:
    """Return the major version of the GPU driver, or `unknown`."""
    try:
        words = _NVIDIA_DRIVER.read_text(encoding="utf-8").split()
    except OSError:
        return "unknown"
    return next((word.partition(".")[0] for word in words if word[0].isdigit()), "unknown")


@dataclass(frozen=True)
class Sampling:
    """The settings of Cycles for a quality."""

    samples: int
    """Paths per pixel."""
    denoiser: Literal["none", "quick", "plain", "guided"] = "none"
    """The denoiser, OpenImageDenoise.

    `guided` also uses albedo and normal, because textures have edges. `quick` is its smallest
    network. On a smooth floor, these guides show the mirrored things, and they are as noisy as the
    gloss. The light of an even cloth therefore uses `plain`.
    """
    seed: int = 0
    """Seed of the sampling noise.

    Every frame has the same seed, so the remaining noise does not flicker, and clips compress.
    """
    skipped: int = 0
    """Paths per pixel to skip first.

    Cycles sends the very first path through the middle of the pixel.
    """


@dataclass(frozen=True)
class ClothSampling:
    """The settings of Cycles for a clip of cloth, whose light is denoised."""

    frame: int
    """Paths per pixel in the whole frame."""
    window: int
    """Paths in the window around the cloth, per pixel of its shading.

    A shading has FINE x FINE pixels for one pixel of a picture.
    """
    floors: tuple[float, float, float]
    """Least PSNR of a clip over the cloth, its landed part and its edge [dB]."""
    reference_ratio: float = 1.0
    """Paths per pixel of a direct rendering, over those of one of a large window."""

    def over(self, area: float) -> ClothSampling:
        """Return a sampling with more paths if the window has a small area [px^2].

        The cost stays the same, down to a certain area.
        """
        ratio = max(_FULL_AREA / max(area, 1.0), 1.0)
        return replace(
            self,
            window=round(self.window * min(ratio, _MAX_PATH_RATIO)),
            reference_ratio=min(ratio, _MAX_REFERENCE_RATIO),
        )

    @property
    def finer(self) -> ClothSampling:
        """Sampling with half the noise, for a clip below its floors."""
        return replace(self, frame=4 * self.frame, window=4 * self.window)


_FULL_AREA = 13_000.0  # least area of a window that needs no additional paths [px^2]
_MAX_REFERENCE_RATIO = 4.0  # the same of direct renderings: few pixels leave much of their noise
_MAX_PATH_RATIO = 1.6  # largest factor of the paths in a smaller window

# These numbers are frozen. A change makes other pictures and another build digest.
# benchmarks/render_rods.py measures the pictures.
SAMPLING = {
    Quality.preview: Sampling(samples=4),
    Quality.draft: Sampling(samples=8),
    Quality.standard: Sampling(samples=28),
    Quality.high: Sampling(samples=128),
}
# The same for cloth, whose clips have thirty frames. benchmarks/render_cloth.py measures the clips.
CLOTH_SAMPLING = {
    Quality.preview: ClothSampling(1, 1, (24.0, 20.0, 21.0)),
    Quality.draft: ClothSampling(1, 3, (30.0, 27.0, 25.0)),
    Quality.standard: ClothSampling(1, 5, (34.0, 30.0, 28.0)),
    Quality.high: ClothSampling(8, 32, (35.0, 31.0, 29.0)),
}


def new_scene(*, max_bounces: int = 2, diffuse_bounces: int = 1, light_tree: bool = True) -> Any:
    """Empty Blender and return its one scene, with the engine set up and a world.

    Blender holds one scene per process. A second call in the same process would empty the first
    scene.
    """
    bpy = import_bpy()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    # Blender makes a directory that the renderer never uses. A killed process would leave it
    # behind.
    with suppress(OSError):
        Path(bpy.app.tempdir).rmdir()
    scene = bpy.context.scene
    render = scene.render
    cycles = scene.cycles
    render.engine = "CYCLES"
    # Render with one thread. Workers run several renderers at the same time, and bytes never depend
    # on the number of threads.
    render.threads_mode = "FIXED"
    render.threads = 1
    render.use_persistent_data = True
    render.use_compositing = False
    render.use_sequencer = False
    render.resolution_percentage = 100
    use_device(scene)
    # Trace the same number of paths for every pixel, without a time limit. No pixel then depends on
    # the machine's load.
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

    # 8-bit values are the sRGB encoding of the light itself, without filmic curve or dither.
    # Colours keep their meaning.
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
