"""Clips of cloth: from a render task to a result, for every scene of cloth.

One shading serves all textures (`stickslip_blender.cloth.shading`) if it passes an image gate. The gate renders one
frame directly, with one texture, and compares means of 4 x 4 pixels: these have little sampling noise, but all errors
of the composition. If the gate fails, every clip is rendered directly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base.keys import content_key, referred
from stickslip_schemas.base.states import Reason
from stickslip_schemas.documents.tasks import RenderOutput, TaskResult
from stickslip_schemas.format.codecs import decode_chunk, encode_chunk
from stickslip_schemas.format.pictures import moving
from stickslip_schemas.spec.cameras import Camera, load_rig
from stickslip_schemas.spec.fabrics import Texture

from stickslip_blender.build import build_digest
from stickslip_blender.cloth.geometry import Geometry, Holders, Surroundings
from stickslip_blender.cloth.ground_truth import ground_truth
from stickslip_blender.cloth.looks import Look, drawn_light, grained, look_of
from stickslip_blender.cloth.scene import ClothScene, Shot
from stickslip_blender.cloth.shading import Sight, settled
from stickslip_blender.cloth.substrates import drawn_substrate, floor_factor
from stickslip_blender.cloth.textures import custom_texture, texture_image
from stickslip_blender.cycles.engine import CLOTH_SAMPLING, ClothSampling, Sampling
from stickslip_blender.raster import Textures
from stickslip_blender.workshop import Workshop, rejected, why_unfit

if TYPE_CHECKING:
    from stickslip_schemas.documents.tasks import RenderTask
    from stickslip_schemas.kinds.cloth.spec import ClothRender
    from stickslip_schemas.kinds.cloth_scene import ClothSceneRender

    AnyLook = ClothRender | ClothSceneRender

GATE = 32.0
"""Least PSNR of composed pictures against direct ones, in means of 4 x 4 pixels of 8-bit sRGB [dB]."""
GATE_TEXTURE = Texture.floral
"""Texture of the gate, with dark, light and saturated places."""
_GATE_SAMPLES = 16
_BLOCK = 4
_PREVIEW_SIDE = 160  # [px]

_KEPT_SHADINGS = 4
"""Shadings that a process keeps: 9 MB each at 30 frames."""

Clip = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Shading:
    """The light of one clip, for all textures."""

    light: npt.NDArray[np.float16]
    """Linear, at the albedos of `shading.ALBEDOS`, shape (frames, height, width, 3)."""
    gate_db: float
    """PSNR at the gate [dB]; it fails below `GATE`."""

    @property
    def composed(self) -> bool:
        """Whether the shading passed the gate, so that pictures are composed of it."""
        return self.gate_db >= GATE


class ClothRenderer:
    """A scene with a cloth of one mesh, built once; everything but the mesh may change between clips."""

    def __init__(
        self,
        triangles: npt.ArrayLike,
        rest: npt.ArrayLike,
        make: Callable[[Any], Surroundings],
        scratch: str | None = None,
    ) -> None:
        """Build the scene that `make` makes of a rest shape (V, 2) [m], with a mesh of triangles (T, 3)."""
        self.geometry = Geometry(triangles, rest, make(rest))
        self.scene = ClothScene(self.geometry, scratch=scratch)

    def close(self) -> None:
        """Release what the scene holds outside Blender."""
        self.scene.close()

    def clip(
        self, look: AnyLook, camera: Camera, positions: npt.ArrayLike, *, sampling: ClothSampling | None = None
    ) -> ClipRenderer:
        """Set the scene for a clip of positions (frames, V', 3) [m], at the instants that `look` names."""
        track = self.geometry.checked(positions)
        fabric = look_of(look.material)
        self.geometry.surface.dress(hem=1e-3 * fabric.hem, creases=look.creases, seed=look.crease_seed)
        light = drawn_light(look.lighting, look.light_seed, look.lamp)
        substrate = drawn_substrate(look.substrate, look.light_seed, look.finish)
        self.scene.set_up(camera, light, substrate, fabric)
        shots = [self.scene.shot(vertices, at) for vertices, at in zip(track, look.instants, strict=True)]
        height = self.geometry.surroundings.floor
        floor = (
            np.ones((camera.height, camera.width, 3), dtype=np.float32)
            if height is None
            else floor_factor(substrate, camera, height)
        )
        chosen = CLOTH_SAMPLING[look.quality] if sampling is None else sampling
        labels = {
            "light_seed": look.light_seed,
            "light": light.numbers,
            "floor": substrate.numbers,
            "lighting": look.lighting,
            "substrate": look.substrate,
            "creases": look.creases,
        }
        return ClipRenderer(self.scene, camera, shots, floor, fabric, chosen, look.light_seed, labels)


@dataclass(frozen=True)
class ClipRenderer:
    """One clip on its scene."""

    scene: ClothScene
    camera: Camera
    shots: Sequence[Shot]
    floor: npt.NDArray[np.float32]
    fabric: Look
    sampling: ClothSampling
    seed: int
    labels: dict[str, Any]

    def shading(self) -> Shading:
        """Trace all frames once, and try on the middle one what composing makes of it."""
        light = np.stack([self.scene.shading(shot, self.sampling, self.seed) for shot in self.shots])
        middle = len(self.shots) // 2
        return Shading(light, self._gate(self.shots[middle], light[middle]))

    def _gate(self, shot: Shot, light: npt.NDArray[np.float16]) -> float:
        picture = grained(texture_image(GATE_TEXTURE), self.fabric, self.scene.geometry.surface)
        window = self.scene.window(shot)
        whole = np.zeros(light.shape, dtype=np.float16)
        whole[window.slices] = self.scene.direct(
            shot, picture, Sampling(_GATE_SAMPLES, "guided", self.seed + 1), window
        )
        direct = self._finished(whole, shot)[window.slices]
        composed = np.empty((1, *light.shape), dtype=np.uint8)
        self._compose(light, shot, Textures([picture]), composed)
        return block_decibels(composed[0][window.slices], direct)

    def clips(self, shading: Shading, textures: Sequence[Clip]) -> tuple[Clip, dict[str, Any]]:
        """Return the clips of textures, and labels that they share.

        Textures: pictures as `texture_image` returns them; clips: shape (textures, frames, height, width, 3).
        """
        pictures = [grained(texture, self.fabric, self.scene.geometry.surface) for texture in textures]
        packed = Textures(pictures)
        camera = self.camera
        videos = np.empty((len(pictures), len(self.shots), camera.height, camera.width, 3), dtype=np.uint8)
        sights = []
        for number, (shot, light) in enumerate(zip(self.shots, shading.light, strict=True)):
            sights.append(self._compose(light, shot, packed, videos[:, number]))
            if not shading.composed:
                videos[:, number] = list(self._direct(shot, pictures))
        labels = self.labels | {
            "frame_share": float(np.mean([sight.frame_share for sight in sights])),
            "visible_share": float(np.mean([sight.visible_share for sight in sights])),
            "gate_db": shading.gate_db,
            "composed": shading.composed,
        }
        return videos, labels

    def ground_truth(self, names: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
        """Return ground truth of every pixel (frames, height, width, ...), by name."""
        if not names:
            return {}
        points = [shot.points for shot in self.shots]
        known = [
            ground_truth(self.scene.geometry, here, following, self.camera)
            for here, following in zip(points, [*points[1:], points[-1]], strict=True)
        ]
        return {name: np.stack([getattr(frame, name) for frame in known]) for name in names}

    def _compose(self, light: npt.NDArray[np.float16], shot: Shot, textures: Textures, pictures: Clip) -> Sight:
        return self.scene.composer.compose(
            light, shot.points, self.camera, self.scene.substrate, self.floor, textures, pictures
        )

    def _direct(self, shot: Shot, pictures: Sequence[Clip]) -> Iterator[Clip]:
        for picture in pictures:
            yield self._finished(
                self.scene.direct(shot, picture, Sampling(self.sampling.window, "guided", self.seed)), shot
            )

    def _finished(self, light: npt.NDArray[np.float16], shot: Shot) -> Clip:
        return settled(self.scene.composer.on_floor(light, shot.points, self.camera, self.floor))


def block_decibels(one: Clip, other: Clip) -> float:
    """Return the PSNR between the means of 4 x 4 pixels of two pictures (height, width, 3)."""
    rows, columns = (size // _BLOCK * _BLOCK for size in one.shape[:2])
    difference = one[:rows, :columns].astype(np.float64) - other[:rows, :columns]
    blocks = difference.reshape(rows // _BLOCK, _BLOCK, columns // _BLOCK, _BLOCK, 3).mean(axis=(1, 3))
    return float(10.0 * np.log10(255.0**2 / max(float((blocks**2).mean()), 1e-3)))


def render_clips(
    look: AnyLook,
    task: RenderTask,
    workshop: Workshop,
    make: Callable[[Any], Surroundings],
    *,
    sheet: str = "",
    frame: Callable[[Geometry], Camera] | None = None,
) -> TaskResult:
    """Render the clips of a task on the scene that `make` makes of a rest shape.

    `sheet` is before the names of the cloth's arrays. With `frame`, which makes the camera where the task has none, the
    camera is a label.
    """
    record = workshop.record(task.record)
    track, rest, triangles = (record[f"{sheet}{name}"] for name in ("positions", "rest", "triangles"))
    if not np.isfinite(track).all():
        return rejected(Reason.invalid_sample, "the cloth has positions that are not finite")
    renderer = workshop.renderer(
        (look.kind, None if make is Holders else task.record, triangles.tobytes(), rest.tobytes()),
        lambda: ClothRenderer(triangles, rest, make, workshop.scratch),
    )
    camera = look.camera or (frame(renderer.geometry) if frame else rig_camera(look))
    if unfit := why_unfit("cloth", track, 0.0, (camera,)):
        return unfit
    clip = renderer.clip(look, camera, track[list(look.instants)])
    shading = _shading(clip, look, task, workshop)
    known = {name: workshop.chunk(values) for name, values in clip.ground_truth(look.ground_truth).items()}
    wanted = task.textures or (look.variant,)
    videos, labels = clip.clips(shading, [picture(name, workshop) for name in wanted])
    labels |= {"camera": camera.numbers} if frame else {}
    if not task.textures:
        preview = workshop.store.publish(moving(videos[0], side=_PREVIEW_SIDE)) if task.preview else None
        chunks = {"video": workshop.clip(videos[0]), **known}
        return TaskResult(outcome="succeeded", output=RenderOutput(chunks=chunks, preview=preview, labels=labels))
    output = RenderOutput(
        chunks=known,
        labels=labels,
        clips={texture: workshop.clip(video) for texture, video in zip(wanted, videos, strict=True)},
        previews={
            texture: workshop.store.publish(moving(video, side=_PREVIEW_SIDE))
            for texture, video in zip(wanted, videos, strict=True)
        }
        if task.preview
        else {},
    )
    return TaskResult(outcome="succeeded", output=output)


def rig_camera(look: AnyLook) -> Camera:
    """Return the camera of a viewpoint of the rig."""
    assert look.rig is not None
    return next(camera for camera in load_rig(look.rig) if camera.name == look.viewpoint)


def picture(texture: str, workshop: Workshop) -> Clip:
    """Return the picture of a texture that is built in, or that a user has put into the store."""
    digest = referred(texture)
    return texture_image(Texture(texture)) if digest is None else custom_texture(workshop.store.read(digest))


def _shading(clip: ClipRenderer, look: AnyLook, task: RenderTask, workshop: Workshop) -> Shading:
    """Return the shading of a clip: one that was made before, if it is still kept, or a new one."""
    light = {name: value for name, value in look.shading.items() if name != "ground_truth"}
    shared = {"record": task.record.model_dump(), "look": light, "build": build_digest(look.kind)}
    key = content_key("shading", shared)
    kept = workshop.shadings
    if key not in kept:
        stored = workshop.kept_shading(key)
        if stored is None:
            kept[key] = clip.shading()
            workshop.keep_shading(key, _packed(kept[key]))
        else:
            kept[key] = _unpacked(stored, (len(clip.shots), clip.camera.height, clip.camera.width, 3))
        while len(kept) > _KEPT_SHADINGS:
            kept.popitem(last=False)
    kept.move_to_end(key)
    return kept[key]


def _packed(shading: Shading) -> bytes:
    """Return a shading as bytes: the gate's verdict, and the light."""
    return np.float64(shading.gate_db).tobytes() + encode_chunk(shading.light)


def _unpacked(data: bytes, shape: tuple[int, ...]) -> Shading:
    light = np.empty(shape, dtype=np.float16)
    decode_chunk(data[8:], light)
    return Shading(light, float(np.frombuffer(data[:8])[0]))
