"""Objects of a Blender scene: meshes, materials, the lamp, the camera, and ambient light."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

from stickslip_blender.cycles.engine import import_bpy

SENSOR_WIDTH = 36.0  # [mm]; only the ratio of focal length to sensor width matters
_CLIP = (1e-3, 1e3)  # [scene units]
SHARP = np.radians(40.0)
"""Angle between faces above which an edge splits a smooth skin [rad]."""

# Least roughness for every ray that does not come from the camera. At 0.4, the light of a steel
# floor was twice as noisy.
SOFT = 0.6

_MIX_INPUTS = (
    "Factor_Float",
    "A_Color",
    "B_Color",
)  # the node's sockets share their names, one set per data type

Array = npt.NDArray[np.float64]


def add_mesh(scene: Any, name: str, vertices: npt.ArrayLike, faces: Sequence[Sequence[int]]) -> Any:
    """Add a mesh of vertices (n, 3) and polygons, and return its data.

    It is smooth except at edges above `SHARP`.
    """
    bpy = import_bpy()
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(np.asarray(vertices).tolist(), [], [list(face) for face in faces])
    scene.collection.objects.link(bpy.data.objects.new(name, mesh))
    mesh.shade_smooth()
    mesh.set_sharp_from_angle(angle=SHARP)
    return mesh


def move_mesh(mesh: Any, points: npt.ArrayLike) -> None:
    """Move the vertices of a mesh to points (n, 3)."""
    mesh.attributes["position"].data.foreach_set(
        "vector", np.asarray(points, dtype=np.float32).ravel()
    )
    mesh.update()


def add_material(mesh: Any, name: str, **inputs: Any) -> Any:
    """Give a mesh a material of the Principled shader, and return the shader.

    `inputs` has the form of `set_inputs`.
    """
    material = import_bpy().data.materials.new(name)
    shader = material.node_tree.nodes["Principled BSDF"]
    set_inputs(shader, **inputs)
    mesh.materials.append(material)
    return shader


def set_inputs(shader: Any, **inputs: Any) -> None:
    """Set inputs of a shader by name, with `_` for a blank."""
    for words, value in inputs.items():
        shader.inputs[words.replace("_", " ")].default_value = value


def set_roughness(shader: Any, roughness: float) -> None:
    """Set the roughness of a shader for rays of the camera.

    Every other ray meets a roughness of at least `SOFT`. Otherwise a mirror shows the lamp in the
    gloss of cloth, and no number of paths cures that noise. Cycles has its own remedies: no
    caustics, filtered gloss, clamped light. They act on paths by the albedos that the paths meet,
    so dark prints would shine more.
    """
    tree = shader.id_data
    softened = tree.nodes.get("softened")
    if softened is None:
        softened = tree.nodes.new("ShaderNodeMapRange")
        softened.name = "softened"
        is_camera_ray = tree.nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"]
        tree.links.new(is_camera_ray, softened.inputs["Value"])
        tree.links.new(softened.outputs["Result"], shader.inputs["Roughness"])
    set_inputs(softened, To_Min=max(roughness, SOFT), To_Max=roughness)


class Lamp:
    """A round area lamp that cameras do not see."""

    def __init__(self, scene: Any) -> None:
        data = import_bpy().data.lights.new("lamp", "AREA")
        data.shape = "DISK"
        self._lamp = import_bpy().data.objects.new("lamp", data)
        self._lamp.visible_camera = False
        scene.collection.objects.link(self._lamp)

    def set_source(self, watts: float, diameter: float) -> None:
        """Set the power [W] and the diameter [scene units]."""
        self._lamp.data.energy = watts
        self._lamp.data.size = diameter

    def aim(self, at: Array, outward: Array, distance: float) -> None:
        """Place the lamp at a distance from a point, and turn it to the point.

        `outward` is the direction of the lamp from the point.
        """
        from mathutils import Vector

        self._lamp.location = at + distance * outward
        self._lamp.rotation_euler = Vector(outward.tolist()).to_track_quat("Z", "Y").to_euler()


class Fabric:
    """The material of a cloth, with a colour or a picture.

    It is the Principled shader, mixed with translucency.
    """

    def __init__(self, mesh: Any, uv: Array, corners: npt.NDArray[np.int32]) -> None:
        """Give a mesh texture coordinates (V, 2) and the material.

        `corners` has the vertex of each corner, in the order of the faces.
        """
        mesh.uv_layers.new(name="rest").uv.foreach_set(
            "vector", uv[corners].astype(np.float32).ravel()
        )
        self._shader = add_material(mesh, "fabric", Sheen_Roughness=0.5)
        self._tree = tree = mesh.materials[0].node_tree
        self._picture = tree.nodes.new("ShaderNodeTexImage")
        self._picture.extension = "EXTEND"
        self._camera_color, self._ray_color = (
            tree.nodes.new("ShaderNodeRGB").outputs["Color"] for _ in range(2)
        )
        self._even = mix_by_ray(tree, self._ray_color, self._camera_color)
        self._color = tree.nodes.new("NodeReroute")
        through = tree.nodes.new("ShaderNodeBsdfTranslucent")
        self._both = tree.nodes.new("ShaderNodeMixShader")
        tree.links.new(self._color.outputs[0], self._shader.inputs["Base Color"])
        tree.links.new(self._color.outputs[0], through.inputs["Color"])
        tree.links.new(self._shader.outputs["BSDF"], self._both.inputs[1])
        tree.links.new(through.outputs["BSDF"], self._both.inputs[2])
        tree.links.new(
            self._both.outputs["Shader"], tree.nodes["Material Output"].inputs["Surface"]
        )
        self._from: Any = None

    def set_look(
        self, *, roughness: float, specular: float, sheen: float, translucency: float
    ) -> None:
        set_roughness(self._shader, roughness)
        set_inputs(self._shader, Specular_IOR_Level=specular, Sheen_Weight=sheen)
        set_inputs(self._both, Fac=translucency)

    def set_color(self, color: Sequence[float], other: Sequence[float] | None = None) -> None:
        """Give the cloth a linear colour.

        Rays that do not come from the camera may see another colour.
        """
        self._camera_color.default_value = (*color, 1.0)
        self._ray_color.default_value = (*(other or color), 1.0)
        self._connect(self._even)

    def set_picture(self, picture: npt.NDArray[np.uint8]) -> None:
        """Print a picture on the cloth, (size, size, 3), 8-bit sRGB, row 0 at its lower edge."""
        images = import_bpy().data.images
        old = self._picture.image
        image = images.new(
            "print", *picture.shape[:2]
        )  # a new image, because Cycles does not read a changed one again
        set_pixels(image, picture / np.float32(255))
        image.update()
        self._picture.image = image
        if old is not None:
            images.remove(old)
        self._connect(self._picture.outputs["Color"])

    def _connect(self, color: Any) -> None:
        if self._from != color:
            self._tree.links.new(color, self._color.inputs[0])
            self._from = color


def mix_by_ray(tree: Any, ray_color: Any, camera_color: Any) -> Any:
    """Return the socket of a colour: `seen` for rays of the camera, `other` for the rest."""
    mix = tree.nodes.new("ShaderNodeMix")
    mix.data_type = "RGBA"
    # A mix node has inputs of all data types. Identifiers distinguish the inputs of colours.
    sockets = {socket.identifier: socket for socket in mix.inputs}
    factor, a, b = (sockets[identifier] for identifier in _MIX_INPUTS)
    tree.links.new(tree.nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"], factor)
    tree.links.new(ray_color, a)
    tree.links.new(camera_color, b)
    return next(o for o in mix.outputs if o.identifier == "Result_Color")


def set_pixels(image: Any, color: npt.NDArray[np.floating[Any]]) -> None:
    """Set the pixels of an image from colours (height, width, 3 or 1 for grey)."""
    rgba = np.ones((*color.shape[:2], 4), dtype=np.float32)
    rgba[..., :3] = color
    image.pixels.foreach_set(rgba.ravel())


def add_view(scene: Any) -> Any:
    """Add a perspective camera to the scene, make it the scene's camera, and return it."""
    bpy = import_bpy()
    data = bpy.data.cameras.new("view")
    data.type = "PERSP"
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = SENSOR_WIDTH
    data.clip_start, data.clip_end = _CLIP
    view = bpy.data.objects.new("view", data)
    scene.collection.objects.link(view)
    scene.camera = view
    return view


def set_view(scene: Any, camera: Camera) -> None:
    """Make the scene's camera project as `camera` does.

    Blender's camera looks along -z with y up. Its shifts are in units of the image's width, in
    square pixels.
    """
    from mathutils import Matrix

    render = scene.render
    view = scene.camera
    render.resolution_x = camera.width
    render.resolution_y = camera.height
    # For pixels that are not square, Blender takes aspects of at least 1 and measures in the
    # narrower of the two.
    ratio = camera.fx / camera.fy  # a pixel's height over its width
    render.pixel_aspect_x = max(1.0, 1.0 / ratio)
    render.pixel_aspect_y = max(1.0, ratio)
    view.data.lens = camera.fx / camera.width * SENSOR_WIDTH
    view.data.shift_x = ((camera.width - 1) / 2 - camera.cx) / camera.width
    view.data.shift_y = (camera.cy - (camera.height - 1) / 2) / camera.width * ratio
    pose = np.eye(4)
    pose[:3, :3] = np.asarray(camera.rotation).T @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = camera.position
    view.matrix_world = Matrix(pose.tolist())


HEIGHT = 64  # rows of the panorama, few because its light is smooth


@dataclass(frozen=True)
class SoftBox:
    """A soft light at infinity, without an edge.

    Its radiance falls off from its middle as cos^sharpness of the angle.

    Area lights would cost more. Cycles picks one of them at random at each sample, and on a thin
    rod that was 6 dB noisier at equal samples.
    """

    azimuth: float
    """Azimuth from the scene, from +x towards +y [degree]."""
    elevation: float
    """Angle above the horizon [degree]."""
    radiance: float
    """Radiance in the middle.

    A white matt thing under a sky of radiance 1 is white in the picture.
    """
    sharpness: float
    """Exponent of the fall-off. For example, 2 is wide, and 8 is a window."""


def panorama(boxes: Sequence[SoftBox], ambient: float) -> npt.NDArray[np.float32]:
    """Return the radiance of soft boxes and an even ambient light.

    The shape is (HEIGHT, 2 HEIGHT), with row 0 lowest. Column c of n looks to azimuth 180 - 360 (c
    + 1/2) / n degrees, as Blender's equirectangular mapping does.
    """
    elevation = np.pi * ((np.arange(HEIGHT) + 0.5) / HEIGHT - 0.5)[:, None]
    azimuth = np.pi * (1.0 - (np.arange(2 * HEIGHT) + 0.5) / HEIGHT)[None, :]
    light = np.full((HEIGHT, 2 * HEIGHT), ambient)
    for box in boxes:
        a = np.radians(box.azimuth)
        e = np.radians(box.elevation)
        cosine = np.cos(elevation) * np.cos(e) * np.cos(azimuth - a) + np.sin(elevation) * np.sin(e)
        light += box.radiance * np.maximum(cosine, 0.0) ** box.sharpness
    return light.astype(np.float32)


def set_environment(scene: Any, light: npt.NDArray[np.float32], ground: float) -> None:
    """Light the scene with a panorama.

    Cameras see a ground of even radiance instead of the panorama.
    """
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
    """Light the scene evenly from all around with a low radiance.

    Cameras see black instead of this light.
    """
    scene.world.color = (0.0, 0.0, 0.0)
    tree, surface = _emptied(scene)
    dark = tree.nodes.new("ShaderNodeBackground")
    set_inputs(dark, Color=(0.0, 0.0, 0.0, 1.0))
    faint = tree.nodes.new("ShaderNodeBackground")
    set_inputs(faint, Color=(ambient, ambient, ambient, 1.0))
    mix = tree.nodes.new("ShaderNodeMixShader")
    tree.links.new(
        tree.nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"], mix.inputs["Fac"]
    )
    tree.links.new(faint.outputs["Background"], mix.inputs[1])
    tree.links.new(dark.outputs["Background"], mix.inputs[2])
    tree.links.new(mix.outputs["Shader"], surface)
    scene.world.cycles.sampling_method = (
        "NONE"  # leaving paths find this light, so the lamp gets all shadow rays
    )


def _emptied(scene: Any) -> tuple[Any, Any]:
    """Empty the node tree of the world, and return it and the socket of its surface."""
    tree = scene.world.node_tree
    tree.nodes.clear()
    return tree, tree.nodes.new("ShaderNodeOutputWorld").inputs["Surface"]
