"""The stage of all scenes of cloth, in Blender: a cloth over a floor, under one lamp, before black.

The cloth is the solver's, refined so that no facet shows. The lamp follows it along the stage [thesis, 4.2.3]. What
else stands there is the scene's: see `stickslip_blender.scenes`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

from stickslip_blender.blender import import_bpy
from stickslip_blender.engine import ClothSampling, Sampling, new_scene, set_sampling
from stickslip_blender.geometry import FLOOR, Geometry, Prop, mirrored
from stickslip_blender.lights import Light
from stickslip_blender.looks import Look
from stickslip_blender.multiplexed import ALBEDOS, Composer
from stickslip_blender.pixels import FrameReader, Window
from stickslip_blender.raster import projected, window_about
from stickslip_blender.substrates import Substrate
from stickslip_blender.view import new_view, set_view

_LAMP_DISTANCE = 1.2  # [m]
_LAMP_SIZE = 0.5  # [m], diameter
_LAMP_POWER = 24.0  # [W]
_AMBIENT = 0.012  # radiance of the black curtains around the stage; cameras see none of it
_FLOOR_RADIUS, _FLOOR_RIM = 8.0, 0.6  # [m]: the rim hides the horizon from a camera 8 degrees above the floor
_WINDOW_MARGIN = 4  # [px] about the cloth
_MIRRORING = 0.3  # roughness below which a floor's mirror image is in the window too

Clip = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Shot:
    """Where everything is at one instant."""

    points: npt.NDArray[np.float64]
    """All vertices, shape (V, 3) [m]."""
    aim: npt.NDArray[np.float64]
    """What the lamp points to, shape (3,) [m]."""


class ClothStage:
    """A stage with one cloth, built once; only vertices, textures, camera, floor and lamp change between frames.

    Blender is one scene per process: a second stage in the same process would empty the first.
    """

    def __init__(self, geometry: Geometry, *, scratch: str | Path | None = None) -> None:
        self.geometry = geometry
        self.composer = Composer(geometry)
        self._scene = new_scene()
        self._scene.cycles.max_bounces = 3
        self._scene.cycles.diffuse_bounces = 2
        self._scene.cycles.glossy_bounces = 1
        self._scene.cycles.use_light_tree = False  # one lamp: there is nothing to choose
        _set_curtains(self._scene)
        self._lamp = _add_lamp(self._scene)
        self._floor = _Floor(self._scene)
        self._mesh = _add_cloth(self._scene, geometry)
        self._fabric = _Fabric(self._mesh)
        self._props = [_add_prop(self._scene, prop) for prop in geometry.stage.props]
        new_view(self._scene)
        self._reader = FrameReader(self._scene, scratch)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of what it holds outside Blender."""
        self._reader.close()

    def set_up(self, camera: Camera, light: Light, substrate: Substrate, look: Look) -> None:
        """Set the camera, the lamp, the floor and the fabric of the clips to come."""
        set_view(self._scene, camera)
        self._camera, self._light, self.substrate = camera, light, substrate
        self._fabric.set_look(look)
        self._lamp.data.energy = _LAMP_POWER * light.power
        self._floor.set(substrate)

    def shading(self, shot: Shot, sampling: ClothSampling, seed: int) -> npt.NDArray[np.float16]:
        """Trace one instant for all textures: linear light at ALBEDOS, shape (height, width, 3).

        Seed: of the noise; the same in all frames of a clip, so that what is left of it does not flicker.
        """
        self._fabric.set_color(ALBEDOS)
        self._place(shot)
        set_sampling(self._scene, Sampling(sampling.frame, "plain", seed))
        light = self._reader.read_light()
        part = self.window(shot)
        set_sampling(self._scene, Sampling(sampling.window, "plain", seed))
        light[part.slices] = self._reader.read_light(part)
        return light

    def direct(
        self, shot: Shot, picture: npt.NDArray[np.uint8], sampling: Sampling, window: Window | None = None
    ) -> npt.NDArray[np.float16]:
        """Render one instant, or a window of it, with a texture on the cloth, the slow way: linear light (h, w, 3)."""
        self._fabric.set_picture(picture)
        self._place(shot)
        set_sampling(self._scene, sampling)
        return self._reader.read_light(window)

    def window(self, shot: Shot) -> Window:
        """Return the part of the frame that the cloth is in, and its image in a floor that mirrors it."""
        cloth = shot.points[: self.geometry.cloth_vertices]
        if self.substrate.roughness < _MIRRORING:
            cloth = np.concatenate([cloth, mirrored(cloth)])
        return window_about(projected(self._camera, cloth), self._camera, _WINDOW_MARGIN)

    def shot(self, positions: npt.NDArray[np.float64], instant: int) -> Shot:
        """Return where everything is at an instant of the motion, the solver's vertices at positions (V', 3) [m]."""
        return Shot(self.geometry.points(positions, instant), self.geometry.stage.aim(instant, positions))

    def _place(self, shot: Shot) -> None:
        """Move everything to where it is."""
        from mathutils import Vector

        cloth = shot.points[: self.geometry.cloth_vertices]
        for mesh, points in zip((self._mesh, *self._props), (cloth, *self.geometry.of_props(shot.points)), strict=True):
            mesh.attributes["position"].data.foreach_set("vector", points.astype(np.float32).ravel())
            mesh.update()
        a, e = np.radians(self._light.azimuth), np.radians(self._light.elevation)
        outward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        self._lamp.location = shot.aim + _LAMP_DISTANCE * outward
        self._lamp.rotation_euler = Vector(outward.tolist()).to_track_quat("Z", "Y").to_euler()


def _set_curtains(scene: Any) -> None:
    """Light the stage a little from all around, and let cameras see black there."""
    scene.world.color = (0.0, 0.0, 0.0)
    tree = scene.world.node_tree
    tree.nodes.clear()
    seen = tree.nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"]
    dark = tree.nodes.new("ShaderNodeBackground")
    dark.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    faint = tree.nodes.new("ShaderNodeBackground")
    faint.inputs["Color"].default_value = (_AMBIENT, _AMBIENT, _AMBIENT, 1.0)
    mix = tree.nodes.new("ShaderNodeMixShader")
    output = tree.nodes.new("ShaderNodeOutputWorld")
    tree.links.new(seen, mix.inputs["Fac"])
    tree.links.new(faint.outputs["Background"], mix.inputs[1])
    tree.links.new(dark.outputs["Background"], mix.inputs[2])
    tree.links.new(mix.outputs["Shader"], output.inputs["Surface"])
    scene.world.cycles.sampling_method = "NONE"  # found by the paths that leave: the lamp gets all shadow rays


def _add_lamp(scene: Any) -> Any:
    data = import_bpy().data.lights.new("lamp", "AREA")
    data.shape = "DISK"
    data.size = _LAMP_SIZE
    lamp = import_bpy().data.objects.new("lamp", data)
    lamp.visible_camera = False
    scene.collection.objects.link(lamp)
    return lamp


def _add_mesh(scene: Any, name: str, vertices: npt.ArrayLike, faces: Sequence[Sequence[int]]) -> Any:
    bpy = import_bpy()
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(np.asarray(vertices).tolist(), [], [list(face) for face in faces])
    made = bpy.data.objects.new(name, mesh)
    scene.collection.objects.link(made)
    return made


def _new_material(name: str, **inputs: Any) -> Any:
    material = import_bpy().data.materials.new(name)
    shader = material.node_tree.nodes["Principled BSDF"]
    for words, value in inputs.items():
        shader.inputs[words.replace("_", " ")].default_value = value
    return material


class _Floor:
    """A round plate with a low rim, whose finish can be set."""

    def __init__(self, scene: Any) -> None:
        around = 64
        angle = 2.0 * np.pi * np.arange(around) / around
        circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(around)], axis=1) * _FLOOR_RADIUS
        circle[:, 2] = FLOOR
        rim = circle + np.array([0.0, 0.0, _FLOOR_RIM])
        sides = [(k, (k + 1) % around, (k + 1) % around + around, k + around) for k in range(around)]
        vertices = np.concatenate([circle, rim])
        plate = _add_mesh(scene, "floor", vertices, [tuple(range(around)), *sides])
        material = _new_material("floor")
        self._shader = material.node_tree.nodes["Principled BSDF"]
        plate.data.materials.append(material)

    def set(self, substrate: Substrate) -> None:
        """Give the floor a finish, without its marks and colour."""
        self._shader.inputs["Base Color"].default_value = (*(substrate.albedo,) * 3, 1.0)
        self._shader.inputs["Roughness"].default_value = substrate.roughness
        self._shader.inputs["Metallic"].default_value = substrate.metallic
        self._shader.inputs["Specular IOR Level"].default_value = substrate.specular


def _add_cloth(scene: Any, geometry: Geometry) -> Any:
    faces, uv = geometry.surface.triangles, geometry.surface.uv
    mesh = _add_mesh(scene, "cloth", np.column_stack([uv, np.zeros(len(uv))]), faces.tolist()).data
    mesh.shade_smooth()
    mesh.uv_layers.new(name="rest").uv.foreach_set("vector", uv[faces.ravel()].astype(np.float32).ravel())
    return mesh


class _Fabric:
    """The cloth's shader, of one even colour or with a picture."""

    def __init__(self, mesh: Any) -> None:
        material = _new_material("fabric", Sheen_Roughness=0.5)
        self._tree = tree = material.node_tree
        self._shader = tree.nodes["Principled BSDF"]
        self._picture = tree.nodes.new("ShaderNodeTexImage")
        self._picture.extension = "EXTEND"
        self._even = tree.nodes.new("ShaderNodeRGB")
        self._color = tree.nodes.new("NodeReroute")
        through = tree.nodes.new("ShaderNodeBsdfTranslucent")
        self._both = tree.nodes.new("ShaderNodeMixShader")
        tree.links.new(self._color.outputs[0], self._shader.inputs["Base Color"])
        tree.links.new(self._color.outputs[0], through.inputs["Color"])
        tree.links.new(self._shader.outputs["BSDF"], self._both.inputs[1])
        tree.links.new(through.outputs["BSDF"], self._both.inputs[2])
        tree.links.new(self._both.outputs["Shader"], tree.nodes["Material Output"].inputs["Surface"])
        mesh.materials.append(material)
        self._from: Any = None

    def set_look(self, look: Look) -> None:
        """Make it one fabric."""
        self._shader.inputs["Roughness"].default_value = look.roughness
        self._shader.inputs["Specular IOR Level"].default_value = look.specular
        self._shader.inputs["Sheen Weight"].default_value = look.sheen
        self._both.inputs["Fac"].default_value = look.translucency

    def set_color(self, color: tuple[float, float, float]) -> None:
        """Give the cloth one linear colour."""
        self._even.outputs["Color"].default_value = (*color, 1.0)
        self._connect(self._even)

    def set_picture(self, picture: npt.NDArray[np.uint8]) -> None:
        """Print a picture on the cloth, (size, size, 3), 8-bit sRGB, row 0 at its lower edge."""
        images, old = import_bpy().data.images, self._picture.image
        image = images.new("print", *picture.shape[:2])  # a new one: Cycles does not look at an old one again
        rgba = np.ones((*picture.shape[:2], 4), dtype=np.float32)
        rgba[..., :3] = picture / np.float32(255)
        image.pixels.foreach_set(rgba.ravel())
        image.update()
        self._picture.image = image
        if old is not None:
            images.remove(old)
        self._connect(self._picture)

    def _connect(self, node: Any) -> None:
        if self._from is not node:
            self._tree.links.new(node.outputs["Color"], self._color.inputs[0])
            self._from = node


def _add_prop(scene: Any, prop: Prop) -> Any:
    made = _add_mesh(scene, prop.name, prop.vertices, prop.faces)
    made.data.materials.append(_new_material(prop.name, Base_Color=(*prop.color, 1.0), Roughness=prop.roughness))
    if prop.is_smooth:
        made.data.shade_smooth()
    return made.data
