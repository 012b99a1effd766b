"""Clips of cloth: from a render task to a result, for every scene of cloth.

One shading serves all textures (`stickslip_blender.cloth.shading`). Every clip is measured
(`stickslip_blender.cloth.quality`). One that is below the floor of its quality is composed of a finer shading; if that
is no better, the sample is rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base import Reason, content_key, referred
from stickslip_schemas.documents.tasks import ChunkRef, RenderOutput, TaskResult
from stickslip_schemas.format.codecs import decode_chunk, encode_chunk, encode_clip
from stickslip_schemas.format.pictures import moving
from stickslip_schemas.spec.cameras import Camera, load_rig
from stickslip_schemas.spec.names import Texture

from stickslip_blender.cloth import quality
from stickslip_blender.cloth.geometry import Geometry, Holders, Surroundings
from stickslip_blender.cloth.ground_truth import bent, ground_truth
from stickslip_blender.cloth.looks import Look, drawn_light, drawn_substrate, floor_factor, grained, look_of
from stickslip_blender.cloth.quality import BAND, OF_LANDED, PATHS, UNMEASURED, WHOLE, errors, pooled, regions, trio
from stickslip_blender.cloth.scene import ClothScene
from stickslip_blender.cloth.shading import FINE, SHOWN
from stickslip_blender.cloth.textures import custom_texture, texture_image
from stickslip_blender.cycles.engine import CLOTH_SAMPLING, ClothSampling, Sampling
from stickslip_blender.raster import Points, Textures
from stickslip_blender.workshop import Workshop, build_digest, rejected, why_unfit

if TYPE_CHECKING:
    from stickslip_schemas.documents.tasks import RenderTask
    from stickslip_schemas.kinds.cloth_drag import ClothDragRender
    from stickslip_schemas.kinds.cloth_scene import ClothSceneRender

    AnyLook = ClothDragRender | ClothSceneRender

_PREVIEW_SIDE = 160  # [px]
_KEPT_SHADINGS = 2  # of 36 MB each at 30 frames

Clip = npt.NDArray[np.uint8]
Light = npt.NDArray[np.float16]  # linear, at the albedos of `shading.SHOWN`
Reference = tuple[int, npt.NDArray[np.float32]]  # a frame, and its light (renderings, height, width, 3), as in `errors`


class ClothRenderer:
    """A scene with a cloth of one mesh, built once; everything but the mesh may change between clips."""

    def __init__(self, triangles: npt.ArrayLike, rest: npt.ArrayLike, make: Callable[[Any], Surroundings]) -> None:
        """Build the scene that `make` makes of a rest shape (V, 2) [m], with a mesh of triangles (T, 3)."""
        self.geometry = Geometry(triangles, rest, make(rest))
        self.scene = ClothScene(self.geometry)

    def clip(
        self, look: AnyLook, camera: Camera, positions: npt.ArrayLike, *, sampling: ClothSampling | None = None
    ) -> ClipRenderer:
        """Set the scene for a clip of positions (frames, V', 3) [m], at the instants that `look` names."""
        track = self.geometry.checked(positions)
        fabric = look_of(look.material)
        self.geometry.surface.dress(hem=1e-3 * fabric.hem, creases=look.creases, seed=look.crease_seed)
        light = drawn_light(look.lighting, look.light_seed, look.lamp)
        substrate = drawn_substrate(look.substrate, look.light_seed, look.finish)
        pinhole = camera.pinhole()
        self.scene.set_up(pinhole, light, substrate, fabric, track)
        shots = [self.geometry.points(vertices, at) for vertices, at in zip(track, look.instants, strict=True)]
        floor = floor_factor(substrate, pinhole, self.geometry.surroundings.floor)
        area = sum(self.scene.window(shot).area for shot in shots) / len(shots)
        chosen = sampling or CLOTH_SAMPLING[look.quality].over(area)
        of_look = {name: getattr(look, name) for name in ("light_seed", "lighting", "substrate", "creases")}
        labels = of_look | {"light": light.numbers, "floor": substrate.numbers}
        return ClipRenderer(self.scene, camera, pinhole, shots, floor, fabric, chosen, look.light_seed, labels)


@dataclass(frozen=True)
class ClipRenderer:
    """One clip on its scene."""

    scene: ClothScene
    camera: Camera
    pinhole: Camera  # renders what the camera's lens then bends
    shots: Sequence[Points]  # all vertices at each instant
    floor: npt.NDArray[np.float32]
    fabric: Look
    sampling: ClothSampling
    seed: int
    labels: dict[str, Any]

    def shading(self, sampling: ClothSampling | None = None) -> Light:
        """Trace all frames once for all textures, shape (frames, FINE height, FINE width, 3)."""
        return np.stack([self.scene.shading(shot, sampling or self.sampling, self.seed) for shot in self.shots])

    def clips(self, shading: Light, textures: Sequence[Clip]) -> tuple[Clip, dict[str, Any]]:
        """Return the clips of textures, and labels that they share.

        Textures: pictures as `texture_image` returns them; clips: of the pinhole camera, shape (textures, frames,
        height, width, 3).
        """
        packed = Textures(list(map(self._grained, textures)))
        camera = self.pinhole
        videos = np.zeros((packed.count, len(self.shots), camera.height, camera.width, 3), dtype=np.uint8)
        sights = []
        for number, (shot, light) in enumerate(zip(self.shots, shading, strict=True)):
            frame = videos[:, number]
            if number > 0:
                frame[:] = videos[:, number - 1]
            sights.append(
                self.scene.composer.compose(light, shot, camera, self.scene.substrate, self.floor, packed, frame)
            )
        shares = zip(("frame_share", "visible_share"), zip(*sights, strict=True), strict=True)
        return videos, self.labels | {name: float(np.mean(share)) for name, share in shares}

    def weights(self, shading: Light) -> tuple[npt.NDArray[np.float64], list[float]]:
        """Return the weights of pixels by region, (frames, 3, height, width), and their means, for `pooled`."""
        size = (len(shading), self.pinhole.height, FINE, self.pinhole.width, FINE)
        black, shown, bounced = shading.reshape(*size, 3).mean(axis=(2, 4), dtype=np.float32).transpose(3, 0, 1, 2)
        masks = np.stack([regions(self.scene.geometry, shot, self.pinhole) for shot in self.shots])
        light = np.maximum((shown - black) / SHOWN[1] + quality.DARK, quality.DARK)
        weights = masks * (light**-0.5 + quality.BOUNCED * ((shown - bounced) / SHOWN[1]) ** 2 / light)[:, None]
        return weights, (weights.sum(axis=(0, 2, 3)) / np.maximum(masks.sum(axis=(0, 2, 3)), 1)).tolist()

    def measured(self, share: float, group: Sequence[str]) -> list[int]:
        """Draw in which frames a group of textures is measured, a share as `quality.instants` says."""
        return quality.instants(len(self.shots), share, self.sampling.window, (self.seed, *group[0].encode()))

    def references(self, textures: Sequence[Clip], frames: Sequence[int], paths: int = PATHS) -> Iterator[Reference]:
        """Render frames directly with up to three textures, whose greens are the channels of the light."""
        greens = [self._grained(texture)[..., 1] for texture in textures]
        picture = np.stack([*greens, *greens[:1] * (3 - len(greens))], axis=-1)
        for frame in frames:
            shot = self.shots[frame]
            cloth = shot[: self.scene.geometry.cloth_vertices]
            landed = cloth[cloth[:, 2] < quality.landed_top(self.scene.geometry)]
            windows = [self.scene.window(cloth, BAND + 1)] * WHOLE + [self.scene.window(landed, 0)] * OF_LANDED
            light = np.full((len(windows), *self.floor.shape), np.nan, dtype=np.float32)
            factor = self.scene.composer.floor_factor(shot, self.pinhole, self.floor, FINE)[..., 1:2]
            for number, (one, window) in enumerate(zip(light, windows, strict=True), 1):
                if window.area:
                    sampling = Sampling(paths, "none", self.seed + number, skipped=paths)
                    parts = self.scene.direct(shot, picture, sampling, window, FINE) * factor[window.times(FINE).slices]
                    one[window.slices] = parts.reshape(-1, FINE, window.right - window.left, FINE, 3).mean(axis=(1, 3))
            yield frame, light

    def _grained(self, texture: Clip) -> Clip:
        return grained(texture, self.fabric, self.scene.geometry.surface)

    def ground_truth(self, names: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
        """Return ground truth of every pixel (frames, height, width, ...), by name."""
        if not names:
            return {}
        known = [
            ground_truth(self.scene.geometry, here, following, self.camera)
            for here, following in zip(self.shots, [*self.shots[1:], self.shots[-1]], strict=True)
        ]
        return {name: np.stack([frame[name] for frame in known]) for name in names}


def render_clips(
    look: AnyLook,
    task: RenderTask,
    workshop: Workshop,
    make: Callable[[Any], Surroundings],
    *,
    sheet: str = "",
    frame: Callable[[Geometry], Camera] | None = None,
) -> TaskResult:
    """Render the clips of a task on the scene that `make` makes of a rest shape; `sheet`: before the cloth's arrays.

    With `frame`, which makes the camera where the task has none, the camera is a label.
    """
    record = workshop.record(task.record)
    track, rest, triangles = (record[f"{sheet}{name}"] for name in ("positions", "rest", "triangles"))
    if not np.isfinite(track).all():
        return rejected(Reason.invalid_sample, "the cloth has positions that are not finite")
    renderer = workshop.renderer(
        (look.kind, None if make is Holders else task.record, triangles.tobytes(), rest.tobytes()),
        lambda: ClothRenderer(triangles, rest, make),
    )
    camera = look.camera or (frame(renderer.geometry) if frame else rig_camera(look))
    if unfit := why_unfit("cloth", track, 0.0, (camera,)):
        return unfit
    clip = renderer.clip(look, camera, track[list(look.instants)])
    known = {name: workshop.chunk(values) for name, values in clip.ground_truth(look.ground_truth).items()}
    labels = {"camera": camera.numbers} if frame else {}
    results = dict(_results(clip, look, task, workshop, known, labels))
    if not task.textures:
        return results[look.variant]
    return TaskResult(outcome="succeeded", output=RenderOutput(chunks={}, labels={}, clips=results))


def _results(
    clip: ClipRenderer,
    look: AnyLook,
    task: RenderTask,
    workshop: Workshop,
    known: dict[str, ChunkRef],
    labels: dict[str, Any],
) -> Iterator[tuple[str, TaskResult]]:
    """Yield the result of each texture: a clip that is good enough, or a rejection."""
    wanted = task.textures or (look.variant,)
    references = {
        group: list(clip.references([picture(name, workshop) for name in group], clip.measured(look.measured, group)))
        for group in dict.fromkeys(map(trio, wanted))
        if look.measured > 0.0
    }
    for sampling in (clip.sampling, clip.sampling.finer):
        shading = _shading(clip, sampling, look, task, workshop)
        videos, shared = clip.clips(shading, [picture(name, workshop) for name in wanted])
        weighed = clip.weights(shading) if references else None
        poor = {}
        for name, video in zip(wanted, videos, strict=True):
            measured = UNMEASURED
            if weighed is not None:
                (weights, usual), group = weighed, trio(name)
                pairs = [(errors(video[f], lit, group.index(name)), weights[f]) for f, lit in references[group]]
                measured = pooled(pairs, usual)
            if shortfall := measured.shortfall(clip.sampling.floors):
                poor[name] = shortfall
                continue
            video = bent(video, clip.camera)
            preview = workshop.store.publish(moving(video, side=_PREVIEW_SIDE)) if task.preview else None
            chunks = {"video": workshop.chunk(video, encode_clip), **known}
            output = RenderOutput(chunks=chunks, preview=preview, labels=shared | measured.labels | labels)
            yield name, TaskResult(outcome="succeeded", output=output)
        if not poor:
            return
        wanted = tuple(poor)
    yield from ((name, rejected(Reason.poor_pictures, text)) for name, text in poor.items())


def rig_camera(look: AnyLook) -> Camera:
    assert look.rig is not None
    return next(camera for camera in load_rig(look.rig) if camera.name == look.viewpoint)


def picture(texture: str, workshop: Workshop) -> Clip:
    """Return the picture of a texture that is built in, or that a user has put into the store."""
    digest = referred(texture)
    return texture_image(Texture(texture)) if digest is None else custom_texture(workshop.store.read(digest))


def _shading(clip: ClipRenderer, sampling: ClothSampling, look: AnyLook, task: RenderTask, workshop: Workshop) -> Light:
    """Return the shading of a clip: one that was made before, if it is still kept, or a new one."""
    light = {name: value for name, value in look.shading.items() if name not in ("ground_truth", "measured")}
    shared = {
        "record": task.record.model_dump(),
        "look": light,
        "build": build_digest(look.kind),
        "finer": sampling != clip.sampling,
    }
    key = content_key("shading", shared)
    kept = workshop.shadings
    if key not in kept:
        stored = workshop.kept_shading(key)
        if stored is None:
            kept[key] = clip.shading(sampling)
            workshop.keep_shading(key, encode_chunk(kept[key]))
        else:
            size = len(clip.shots), FINE * clip.pinhole.height, FINE * clip.pinhole.width, 3
            kept[key] = np.empty(size, dtype=np.float16)
            decode_chunk(stored, kept[key])
        while len(kept) > _KEPT_SHADINGS:
            kept.popitem(last=False)
    kept.move_to_end(key)
    return kept[key]
