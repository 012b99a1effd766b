"""Light from all around: a panorama of soft boxes, or faint curtains. Cameras see a dark ground instead.

Soft boxes stand at infinity and have no edge. Area lights would cost more: Cycles picks one of them at random at each
sample, and on a thin rod that was 6 dB noisier at equal samples.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_blender.cycles.blender import import_bpy
from stickslip_blender.cycles.objects import mix_by_ray, set_inputs, set_pixels

HEIGHT = 64  # rows of the panorama: its light is smooth


@dataclass(frozen=True)
class SoftBox:
    """A soft light: its radiance falls off with the angle from its middle as cos^sharpness."""

    azimuth: float
    """Direction seen from the scene, from +x towards +y [degree]."""
    elevation: float
    """Above the horizon [degree]."""
    radiance: float
    """In its middle; a white matt thing under a sky of radiance 1 is white in the picture."""
    sharpness: float
    """Exponent; 2 is wide, 8 is a window."""


def panorama(boxes: Sequence[SoftBox], ambient: float) -> npt.NDArray[np.float32]:
    """Return the radiance of soft boxes and an even ambient light, shape (HEIGHT, 2 HEIGHT), row 0 lowest.

    Column c of n looks to azimuth 180 - 360 (c + 1/2) / n degrees, as Blender's equirectangular mapping does.
    """
    elevation = np.pi * ((np.arange(HEIGHT) + 0.5) / HEIGHT - 0.5)[:, None]
    azimuth = np.pi * (1.0 - (np.arange(2 * HEIGHT) + 0.5) / HEIGHT)[None, :]
    light = np.full((HEIGHT, 2 * HEIGHT), ambient)
    for box in boxes:
        a, e = np.radians(box.azimuth), np.radians(box.elevation)
        cosine = np.cos(elevation) * np.cos(e) * np.cos(azimuth - a) + np.sin(elevation) * np.sin(e)
        light += box.radiance * np.maximum(cosine, 0.0) ** box.sharpness
    return light.astype(np.float32)


def set_environment(scene: Any, light: npt.NDArray[np.float32], ground: float) -> None:
    """Light the scene with a panorama; cameras see a ground of even radiance instead."""
    image = import_bpy().data.images.new(
        "panorama", width=light.shape[1], height=light.shape[0], float_buffer=True, is_data=True
    )
    set_pixels(image, light[..., None])
    tree, surface = _emptied(scene)
    sky = tree.nodes.new("ShaderNodeTexEnvironment")
    sky.image = image
    even = tree.nodes.new("ShaderNodeRGB")
    even.outputs["Color"].default_value = (ground, ground, ground, 1.0)
    background = tree.nodes.new("ShaderNodeBackground")
    color = mix_by_ray(tree, sky.outputs["Color"], even.outputs["Color"])
    tree.links.new(color, background.inputs["Color"])
    tree.links.new(background.outputs["Background"], surface)
    scene.world.cycles.sampling_method = "MANUAL"
    scene.world.cycles.sample_map_resolution = 2 * HEIGHT


def set_curtains(scene: Any, ambient: float) -> None:
    """Light the scene evenly from all around with a low radiance; cameras see black instead."""
    scene.world.color = (0.0, 0.0, 0.0)
    tree, surface = _emptied(scene)
    dark = tree.nodes.new("ShaderNodeBackground")
    set_inputs(dark, Color=(0.0, 0.0, 0.0, 1.0))
    faint = tree.nodes.new("ShaderNodeBackground")
    set_inputs(faint, Color=(ambient, ambient, ambient, 1.0))
    mix = tree.nodes.new("ShaderNodeMixShader")
    tree.links.new(tree.nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"], mix.inputs["Fac"])
    tree.links.new(faint.outputs["Background"], mix.inputs[1])
    tree.links.new(dark.outputs["Background"], mix.inputs[2])
    tree.links.new(mix.outputs["Shader"], surface)
    scene.world.cycles.sampling_method = "NONE"  # paths that leave find it: the lamp gets all shadow rays


def _emptied(scene: Any) -> tuple[Any, Any]:
    """Empty the node tree of the world; return it and the socket of its surface."""
    tree = scene.world.node_tree
    tree.nodes.clear()
    return tree, tree.nodes.new("ShaderNodeOutputWorld").inputs["Surface"]
