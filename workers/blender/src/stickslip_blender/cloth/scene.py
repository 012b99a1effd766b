"""The Blender scene of every kind of cloth: a cloth over a floor, under one lamp, before black.

The cloth is the solver's mesh, refined until no facet is visible. The lamp stands still. The module
of a kind in `stickslip_blender.scenes` adds the props.
"""

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

from stickslip_blender.cloth.geometry import Geometry
from stickslip_blender.cloth.looks import FabricAppearance, Light, Substrate
from stickslip_blender.cloth.shading import CAMERA_ALBEDOS, ELSEWHERE, FINE, Composer
from stickslip_blender.cycles.engine import ClothSampling, Sampling, new_scene, set_sampling
from stickslip_blender.cycles.objects import (
    Fabric,
    Lamp,
    add_material,
    add_mesh,
    add_view,
    move_mesh,
    set_curtains,
    set_inputs,
    set_roughness,
    set_view,
)
from stickslip_blender.cycles.pixels import FrameReader
from stickslip_blender.raster import Points, Window, projected, window_about

_LAMP_DISTANCE = 7.2  # [m]
_LAMP_POWER = 940.0  # [W]
_FLOOR_RADIUS = 8.0  # [m]
_FLOOR_RIM = 0.6  # [m]: it hides the horizon from a camera 8 degrees above the floor
_WINDOW_MARGIN = 4  # [px] about the cloth
_DISCARDED = 2  # [px] at a window's border, because the denoiser errs there
_RAMP = 4  # [px of the default size] of the blend between the window and the frame, after them
_MIRRORING = 0.3  # roughness below which a floor shows the cloth, outside the window
_MIRROR_PATHS = 2  # factor of the frame's paths below this roughness


class ClothScene:
    """A scene with one cloth, built once.

    Vertices change between frames. Camera, lamp and looks change between clips.
    """

    def __init__(self, geometry: Geometry) -> None:
        self.geometry = geometry
        self.composer = Composer(geometry)
        self._scene = new_scene(
            max_bounces=3, diffuse_bounces=2, light_tree=False
        )  # one lamp leaves no choice
        cycles = self._scene.cycles  # other rays meet only soft gloss: set_roughness
        cycles.caustics_reflective = True
        cycles.blur_glossy = 0.0
        cycles.sample_clamp_indirect = 0.0
        self._lamp = Lamp(self._scene)
        self._floor = None
        if geometry.surroundings.floor is not None:
            self._floor = add_material(
                add_mesh(self._scene, "floor", *_floor(geometry.surroundings.floor)), "floor"
            )

        # The vertices of the cloth and the props move from frame to frame. Here only faces and
        # texture coordinates count.
        faces = geometry.surface.triangles
        uv = geometry.surface.uv
        flat = np.column_stack([uv, np.zeros(len(uv))])
        cloth = add_mesh(self._scene, "cloth", flat, faces.tolist())
        self._fabric = Fabric(cloth, uv, faces.ravel())
        self._meshes = [cloth]
        for prop in geometry.surroundings.props:
            mesh = add_mesh(self._scene, prop.name, prop.vertices, prop.faces)
            if prop.sheet is None:
                set_roughness(
                    add_material(mesh, prop.name, Base_Color=(*(prop.grey,) * 3, 1.0)),
                    prop.roughness,
                )
            else:
                fabric = Fabric(mesh, prop.sheet.uv, np.concatenate(prop.faces).astype(np.int32))
                fabric.set_look(**_shader(prop.sheet.look))
                fabric.set_color((prop.grey,) * 3)
            self._meshes.append(mesh)
        add_view(self._scene)
        self._reader = FrameReader(self._scene)

    def set_up(
        self,
        camera: Camera,
        light: Light,
        substrate: Substrate,
        look: FabricAppearance,
        track: Points,
        *,
        enlargement: float = 1.0,
    ) -> None:
        """Set the camera, the lamp, the floor and the fabric of the next clips.

        `enlargement` is the shorter side of the pictures over that of the default resolution. The
        lamp points at the middle of the box that contains all vertices of the track (frames,
        V', 3) [m].
        """
        set_view(self._scene, camera)
        self._camera = camera
        # In larger pictures a penumbra is wider, and so is the blend across it.
        self._ramp = max(_RAMP, round(_RAMP * enlargement))
        self.substrate = substrate
        self._fabric.set_look(**_shader(look))
        self._lamp.set_source(_LAMP_POWER * light.power, light.source.diameter)
        # All clips have the same distance, so the same power of the lamp gives the same light.
        a = np.radians(light.azimuth)
        e = np.radians(light.elevation)
        outward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        self._lamp.aim(
            0.5 * (track.min(axis=(0, 1)) + track.max(axis=(0, 1))), outward, _LAMP_DISTANCE
        )
        set_curtains(self._scene, light.source.surround)
        if self._floor is not None:
            set_roughness(self._floor, substrate.roughness)
            set_inputs(
                self._floor, Metallic=substrate.metallic, Specular_IOR_Level=substrate.specular
            )
            set_inputs(self._floor, Base_Color=(*(substrate.albedo,) * 3, 1.0))

    def shading(
        self, points: Points, sampling: ClothSampling, seed: int
    ) -> npt.NDArray[np.float16]:
        """Render an instant for all textures: linear light at three albedos.

        The shape is (FINE height, FINE width, 3). `seed` sets the noise. All frames of a clip have
        the same seed, so the remaining noise does not flicker.
        """
        self._fabric.set_color(CAMERA_ALBEDOS, ELSEWHERE)
        self._place(points)

        # Render the whole frame with few paths, because light on the floor varies slowly.
        paths = sampling.frame * (_MIRROR_PATHS if self.substrate.roughness < _MIRRORING else 1)
        set_sampling(self._scene, Sampling(paths, "quick", seed))
        light = self._reader.read_light().repeat(FINE, axis=0).repeat(FINE, axis=1)

        # Render the window of the cloth with more paths and FINE x FINE values a pixel.
        part = self.window(points, _DISCARDED + self._ramp)
        set_sampling(self._scene, Sampling(sampling.window, "plain", seed))

        # Blend the window into the frame, so that its border is invisible.
        down = _blend_weights(part.top, part.bottom, self._camera.height, self._ramp)
        across = _blend_weights(part.left, part.right, self._camera.width, self._ramp)
        here = part.times(FINE).slices
        finer = self._reader.read_light(part, FINE).astype(np.float32) - light[here]
        light[here] += np.minimum.outer(down, across)[..., None] * finer
        return light

    def direct(
        self,
        points: Points,
        image: npt.NDArray[np.uint8],
        sampling: Sampling,
        window: Window | None = None,
        fine: int = 1,
    ) -> npt.NDArray[np.float16]:
        """Render an instant, or a window of it, with a texture on the cloth.

        The result is linear light (fine h, fine w, 3).
        """
        self._fabric.set_picture(image)
        self._place(points)
        set_sampling(self._scene, sampling)
        return self._reader.read_light(window, fine)

    def window(self, points: Points, margin: int = _WINDOW_MARGIN) -> Window:
        """Return the part of the frame that shows the cloth."""
        cloth = points[: self.geometry.cloth_vertices]
        return window_about(projected(self._camera, cloth), self._camera, margin)

    def _place(self, points: Points) -> None:
        for mesh, part in zip(self._meshes, self.geometry.parts(points), strict=True):
            move_mesh(mesh, part)


def _blend_weights(low: int, high: int, size: int, ramp: int) -> npt.NDArray[np.float32]:
    """Return the weight of a window [low, high) in a frame of a size [px], by finer pixels.

    It rises over `ramp` pixels, smoothly at the window's ends. At the border of the frame it is 1.
    """
    inside = low + (np.arange(FINE * (high - low)) + 0.5) / FINE
    ends = inside - (low if low > 0 else -np.inf), (high if high < size else np.inf) - inside
    step = np.clip((np.minimum(*ends) - _DISCARDED) / ramp, 0.0, 1.0)
    return np.asarray(step * step * (3.0 - 2.0 * step), dtype=np.float32)


def _shader(look: FabricAppearance) -> dict[str, float]:
    """Return the numbers of a look that the shader of a fabric takes."""
    return {
        name: getattr(look, name) for name in ("roughness", "specular", "sheen", "translucency")
    }


def _floor(height: float) -> tuple[npt.NDArray[np.float64], list[tuple[int, ...]]]:
    """Return the vertices and faces of a round plate at a height [m], with a low rim."""
    # The floor is one polygon. Its rim is a ring of upright faces.
    around = 64
    angle = 2.0 * np.pi * np.arange(around) / around
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(around)], axis=1) * _FLOOR_RADIUS
    circle[:, 2] = height
    rim = circle + np.array([0.0, 0.0, _FLOOR_RIM])
    sides = [(k, (k + 1) % around, (k + 1) % around + around, k + around) for k in range(around)]
    return np.concatenate([circle, rim]), [tuple(range(around)), *sides]
