"""The stage of all scenes of cloth: a square of cloth over a dark floor, under one lamp, before black.

The cloth is the solver's, refined so that no facet shows; the rest is dressing. The lamp and the gloss of the floor are
drawn from a seed, within the bounds that `Light` states. What else stands on the stage is the scene's: see
`stickslip_blender.scenes`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from stickslip_schemas.cameras import Camera
from stickslip_schemas.jobs import Quality
from stickslip_schemas.textures import Texture

from stickslip_blender.blender import import_bpy
from stickslip_blender.engine import CLOTH_SAMPLING, Sampling, new_scene, set_sampling
from stickslip_blender.pixels import FrameReader
from stickslip_blender.subdivision import Subdivision, subdivide
from stickslip_blender.textures import SIZE, texture_image
from stickslip_blender.view import new_view, set_view

FINE_VERTICES = 6000
"""A mesh is subdivided until it has so many vertices: a facet is then below a pixel."""

_HALF_THICKNESS = 0.0005  # [m]: the floor is seen so much below the middle surface of a cloth that lies on it
_STAGE_CENTER = np.array([0.15, 0.0, 0.05])  # [m], where the lamp points
_LAMP_DISTANCE = 1.2  # [m]
_LAMP_SIZE = 0.5  # [m], diameter
_LAMP_POWER = 24.0  # [W]
_AMBIENT = 0.012  # radiance of the black curtains around the stage; cameras see none of it


@dataclass(frozen=True)
class Light:
    """The lamp and the floor of one clip, drawn from a seed."""

    azimuth: float
    """Of the lamp, seen from the stage, from +x towards +y [degree]: -75 to 15."""
    elevation: float
    """Of the lamp, above the floor [degree]: 42 to 62."""
    power: float
    """Over the nominal power: 0.8 to 1.25."""
    floor: float
    """Share of the light that the floor scatters: 0.012 to 0.04."""
    roughness: float
    """Of the floor's gloss: 0.25 to 0.45."""

    @classmethod
    def drawn(cls, seed: int) -> Self:
        """Draw a light."""
        draw = np.random.Generator(np.random.PCG64(seed)).uniform
        return cls(
            azimuth=float(draw(-75.0, 15.0)),
            elevation=float(draw(42.0, 62.0)),
            power=float(draw(0.8, 1.25)),
            floor=float(draw(0.012, 0.04)),
            roughness=float(draw(0.25, 0.45)),
        )


class ClothRenderer:
    """A stage with a cloth of one mesh, built once; only vertices, texture, camera and light change between frames.

    Blender is one scene per process: a second renderer in the same process would empty the first.
    """

    def __init__(
        self,
        triangles: npt.ArrayLike,
        rest: npt.ArrayLike,
        *,
        quality: Quality | Sampling = Quality.standard,
        scratch: str | Path | None = None,
    ) -> None:
        """Build the stage for a mesh of triangles (T, 3) with the rest shape (V, 2) [m], held edge last."""
        flat = np.asarray(rest, dtype=np.float64)
        self._vertices = len(flat)
        self._levels, faces, uv = _refined(np.asarray(triangles), flat)
        self._scene = new_scene()
        set_sampling(self._scene, quality if isinstance(quality, Sampling) else CLOTH_SAMPLING[quality])
        self._scene.cycles.max_bounces = 3
        self._scene.cycles.diffuse_bounces = 2
        self._scene.cycles.glossy_bounces = 1
        self._scene.cycles.use_light_tree = False  # one lamp: there is nothing to choose
        _set_curtains(self._scene)
        self._lamp = _add_lamp(self._scene)
        self._floor = _add_floor(self._scene)
        self._mesh = _add_cloth(self._scene, faces, uv)
        self._picture = _add_fabric(self._mesh)
        self.add_props(self._scene, flat)
        self._images: dict[Texture, Any] = {}
        new_view(self._scene)
        self._reader = FrameReader(self._scene, scratch)

    def add_props(self, scene: Any, rest: npt.NDArray[np.float64]) -> None:
        """Put what else stands on the stage into the scene, for a cloth of the rest shape (V, 2) [m]."""
        raise NotImplementedError

    def place_props(self, instant: int, vertices: npt.NDArray[np.float64]) -> None:
        """Move the props to where they are at an instant of the motion, with the cloth at vertices (V, 3) [m]."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of what it holds outside Blender."""
        self._reader.close()

    def render(
        self,
        positions: npt.ArrayLike,
        camera: Camera,
        *,
        texture: Texture,
        light: Light,
        instants: Sequence[int] | None = None,
    ) -> npt.NDArray[np.uint8]:
        """Render positions (frames, V, 3) [m] in turn: 8-bit sRGB, shape (frames, height, width, 3).

        `instants` says at which instants of the motion the frames are, for props that move; by default 0, 1, ...
        """
        track = np.asarray(positions, dtype=np.float64)
        if track.ndim != 3 or track.shape[1:] != (self._vertices, 3) or not np.isfinite(track).all():
            raise ValueError(
                f"positions must be finite, of shape (frames, {self._vertices}, 3); got shape {track.shape}"
            )
        set_view(self._scene, camera)
        self._set_light(light)
        self._picture.image = self._image(texture)
        return np.stack(list(self._frames(track, range(len(track)) if instants is None else instants)))

    def _frames(self, track: npt.NDArray[np.float64], instants: Sequence[int]) -> Iterator[npt.NDArray[np.uint8]]:
        for instant, vertices in zip(instants, track, strict=True):
            self.place_props(instant, vertices)
            fine = vertices
            for level in self._levels:
                fine = level(fine)
            self._mesh.attributes["position"].data.foreach_set("vector", fine.astype(np.float32).ravel())
            self._mesh.update()
            yield self._reader.read()

    def _set_light(self, light: Light) -> None:
        from mathutils import Vector

        a, e = np.radians(light.azimuth), np.radians(light.elevation)
        outward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        self._lamp.location = _STAGE_CENTER + _LAMP_DISTANCE * outward
        self._lamp.rotation_euler = Vector(outward.tolist()).to_track_quat("Z", "Y").to_euler()
        self._lamp.data.energy = _LAMP_POWER * light.power
        self._floor.inputs["Base Color"].default_value = (light.floor, light.floor, light.floor, 1.0)
        self._floor.inputs["Roughness"].default_value = light.roughness

    def _image(self, texture: Texture) -> Any:
        if texture not in self._images:
            image = import_bpy().data.images.new(texture, width=SIZE, height=SIZE)
            rgba = np.ones((SIZE, SIZE, 4), dtype=np.float32)
            rgba[..., :3] = texture_image(texture) / np.float32(255)
            image.pixels.foreach_set(rgba.ravel())
            image.update()
            self._images[texture] = image
        return self._images[texture]


def _refined(
    triangles: npt.NDArray[np.integer[Any]], rest: npt.NDArray[np.float64]
) -> tuple[list[Subdivision], npt.NDArray[np.integer[Any]], npt.NDArray[np.float64]]:
    """Return the subdivisions that a mesh needs, and the triangles and texture coordinates of the finest."""
    levels: list[Subdivision] = []
    faces, fine = triangles, rest
    while len(fine) < FINE_VERTICES:
        levels.append(subdivide(faces, fine))
        faces, fine = levels[-1].triangles, levels[-1](fine)
    low, high = rest.min(axis=0), rest.max(axis=0)
    return levels, faces, (fine - low) / (high - low)


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


def add_object(scene: Any, name: str, vertices: npt.ArrayLike, faces: list[tuple[int, ...]], material: Any) -> Any:
    """Add a mesh to the scene and return its object."""
    bpy = import_bpy()
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(np.asarray(vertices).tolist(), [], faces)
    mesh.materials.append(material)
    made = bpy.data.objects.new(name, mesh)
    scene.collection.objects.link(made)
    return made


def new_material(name: str, **inputs: Any) -> Any:
    """Return a material whose shader has the given inputs."""
    material = import_bpy().data.materials.new(name)
    shader = material.node_tree.nodes["Principled BSDF"]
    for words, value in inputs.items():
        shader.inputs[words.replace("_", " ")].default_value = value
    return material


def _add_floor(scene: Any) -> Any:
    """Return the floor's shader, whose color and roughness are to be set."""
    material = new_material("floor", Base_Color=(0.04, 0.04, 0.04, 1.0), Roughness=0.4, Specular_IOR_Level=0.35)
    half, z = 6.0, -_HALF_THICKNESS
    corners = [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)]
    add_object(scene, "floor", corners, [(0, 1, 2, 3)], material)
    return material.node_tree.nodes["Principled BSDF"]


def _add_cloth(scene: Any, faces: npt.NDArray[np.integer[Any]], uv: npt.NDArray[np.float64]) -> Any:
    bpy = import_bpy()
    mesh = bpy.data.meshes.new("cloth")
    flat = np.column_stack([uv, np.zeros(len(uv))])
    mesh.from_pydata(flat.tolist(), [], faces.tolist())
    mesh.shade_smooth()
    mesh.uv_layers.new(name="rest").uv.foreach_set("vector", uv[faces.ravel()].astype(np.float32).ravel())
    scene.collection.objects.link(bpy.data.objects.new("cloth", mesh))
    return mesh


def _add_fabric(mesh: Any) -> Any:
    """Give the cloth a matt, slightly fuzzy look; return the node whose image is to be set."""
    material = new_material("fabric", Roughness=0.85, Specular_IOR_Level=0.2, Sheen_Weight=0.15, Sheen_Roughness=0.5)
    tree = material.node_tree
    picture = tree.nodes.new("ShaderNodeTexImage")
    picture.extension = "EXTEND"
    tree.links.new(picture.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    mesh.materials.append(material)
    return picture


def box(
    size: tuple[float, float, float], center: tuple[float, float, float]
) -> tuple[npt.NDArray[np.float64], list[tuple[int, ...]]]:
    """Return the corners (8, 3) and faces of a box."""
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces: list[tuple[int, ...]] = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return np.asarray(center) + 0.5 * np.asarray(size) * signs, faces
