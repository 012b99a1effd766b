"""CPU time of a frame of cloth, and its distance from 256 samples, by quality.

A shading serves many textures.

Runs in Blender's interpreter, on a trajectory that `benchmarks/render_trajectory.py` has written:

    .venv/bin/python benchmarks/render_trajectory.py /tmp/cloth.npz .venv-blender/bin/python
    benchmarks/render_cloth.py /tmp/cloth.npz [--frames 12] [--references DIR] [--substrates]
    .venv-blender/bin/python benchmarks/render_cloth.py /tmp/cloth.npz --clip CLIPS.npy

References are rendered directly, with another seed, in the window that the cloth is in; those of
--substrates are denoised, for gloss is still noisy at 256 samples. They take most of the time, and
DIR keeps them. Decibels pool the squared error of 8-bit sRGB over the pixels that the cloth covers
by half or more, over frames, views and textures. CPU time is a median over frames, per frame and
texture, with eight textures.

--look says what hem, thickness, translucency and creases cost, and --ground-truth what all its
arrays cost, written to a store too: both against a shading and its composition, in turns, so that
other work on the machine slows both alike.

--clip makes what a render process makes of a task, 8 clips of 30 frames in a store, says how much
of its time is not Blender's, and writes the clips to a file.
"""

import argparse
import hashlib
import io
import platform
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_blender.actor import RenderActor
from stickslip_blender.cloth.clips import ClothRenderer
from stickslip_blender.cloth.geometry import FLOOR, Holders
from stickslip_blender.cloth.ground_truth import ground_truth
from stickslip_blender.cloth.looks import (
    HARD,
    Substrate,
    drawn_light,
    drawn_substrate,
    fabric_appearance,
    floor_factor,
    print_on_fabric,
)
from stickslip_blender.cloth.textures import texture_image
from stickslip_blender.cycles.engine import CLOTH_SAMPLING, ClothSampling, Sampling, import_bpy
from stickslip_blender.cycles.pixels import FrameReader, encode
from stickslip_blender.raster import Points, Textures, Window, projected, see
from stickslip_blender.render_context import RenderContext, build_digest
from stickslip_schemas.documents.tasks import RecordRef, RenderOutput, RenderTask, TaskResult
from stickslip_schemas.format.codecs import decode_clip
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.spec.arrays import shown_frames
from stickslip_schemas.spec.cameras import load_rig, rig_digest
from stickslip_schemas.spec.jobs import Quality
from stickslip_schemas.spec.names import Texture
from stickslip_schemas.store import DirectoryStore

MATERIAL = "gray-interlock"
TEXTURES = tuple(Texture)[:8]
COMPARED = (Texture.checker, Texture.houndstooth, Texture.floral)
CREASES = 0.5
REFERENCE = Sampling(samples=256, seed=1)
"""What pictures are compared with; its seed is another, so that it shares no noise with them."""
SMOOTH = Sampling(REFERENCE.samples, "guided", REFERENCE.seed)


@dataclass(frozen=True)
class View:
    """One instant, seen by one camera."""

    frame: int
    view: int
    substrate: Substrate

    @property
    def name(self) -> str:
        return f"{self.substrate.name}-{self.frame}-{self.view}"


class Bench:
    """A stage with a simulated cloth on it."""

    def __init__(self, trajectory: Path, references: Path | None) -> None:
        with np.load(trajectory) as file:
            self.track = file["track"].astype(np.float64)
            self.renderer = ClothRenderer(file["triangles"], file["rest"], Holders)
        self.look = fabric_appearance(MATERIAL)
        self.pictures = {
            texture: print_on_fabric(
                texture_image(texture), self.look, self.renderer.geometry.surface
            )
            for texture in TEXTURES
        }
        self.textures = Textures(list(self.pictures.values()))
        self.geometry, self.scene = self.renderer.geometry, self.renderer.scene
        self.geometry.surface.apply_relief(hem=1e-3 * self.look.hem, creases=CREASES, seed=1)
        self.rig = load_rig("drag")[:3]
        build = hashlib.sha256((build_digest("cloth_drag") + str(trajectory)).encode()).hexdigest()[
            :12
        ]
        self.references = references and references / build

    def set_up(self, shot: View) -> tuple[Points, npt.NDArray[np.float32]]:
        """Return where everything is, and the floor's factor."""
        camera = self.rig[shot.view]
        self.scene.set_up(
            camera, drawn_light("drawn", shot.view), shot.substrate, self.look, self.track
        )
        return self.geometry.points(self.track[shot.frame], shot.frame), floor_factor(
            shot.substrate, camera, FLOOR
        )

    def reference(self, view: View, texture: Texture) -> tuple[Window, npt.NDArray[np.uint8]]:
        """Return the window and what it should look like."""
        shot, floor = self.set_up(view)
        window = self.scene.window(shot)
        stored = self.references and self.references / f"{view.name}-{texture}.npy"
        if stored is not None and stored.exists():
            return window, np.load(stored)
        camera = self.rig[view.view]
        light = np.zeros((camera.height, camera.width, 3), dtype=np.float16)
        light[window.slices] = self.scene.direct(
            shot,
            self.pictures[texture],
            REFERENCE if view.substrate.name == "matt" else SMOOTH,
            window,
        )
        picture = encode(light * self.scene.composer.floor_factor(shot, camera, floor))[
            window.slices
        ]
        if stored is not None:
            stored.parent.mkdir(parents=True, exist_ok=True)
            np.save(stored, picture)
        return window, picture

    def composed(
        self, view: View, sampling: ClothSampling
    ) -> tuple[npt.NDArray[np.uint8], float, float]:
        """Return the pictures of all textures, the seconds of Cycles and those of all the rest."""
        shot, floor = self.set_up(view)
        placed = time.process_time()
        shading = self.scene.shading(shot, sampling, seed=7)
        traced = time.process_time()
        camera = self.rig[view.view]
        pictures = np.zeros((len(TEXTURES), camera.height, camera.width, 3), dtype=np.uint8)
        self.scene.composer.compose(
            shading, shot, camera, view.substrate, floor, self.textures, pictures
        )
        ended = time.process_time()
        return pictures, traced - placed, ended - traced + self._per_frame(view)

    def _per_frame(self, view: View) -> float:
        """Return the seconds to place everything, once a frame.

        The rest of `set_up` is done once a clip.
        """
        start = time.process_time()
        self.geometry.points(self.track[view.frame], view.frame)
        return time.process_time() - start

    def direct(
        self, view: View, texture: Texture, sampling: Sampling
    ) -> tuple[npt.NDArray[np.uint8], float]:
        """Return a picture rendered directly, and its seconds."""
        shot, floor = self.set_up(view)
        start = time.process_time()
        light = self.scene.direct(shot, self.pictures[texture], sampling)
        spent = time.process_time() - start
        return encode(
            light * self.scene.composer.floor_factor(shot, self.rig[view.view], floor)
        ), spent

    def cloth(self, view: View, window: Window) -> npt.NDArray[np.bool_]:
        """Return which pixels of a window the cloth covers by half or more."""
        points = self.geometry.points(self.track[view.frame], view.frame)
        visible = see(projected(self.rig[view.view], points), self.geometry.triangles, window)
        share: npt.NDArray[np.bool_] = visible.share_below(self.geometry.cloth_triangles) >= 0.5
        return share


def decibels(errors: list[npt.NDArray[np.float64]]) -> float:
    """Return the PSNR of pooled squared errors."""
    return float(10.0 * np.log10(255.0**2 / max(float(np.concatenate(errors).mean()), 1e-9)))


def squared(a: npt.NDArray[np.uint8], b: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
    return (a.astype(np.float64) - b) ** 2


def shots(track: npt.NDArray[np.float64], count: int, names: tuple[str, ...]) -> Iterator[View]:
    """Yield `count` instants in each of three views, of each substrate."""
    for name in names:
        for frame in np.linspace(8, len(track) - 1, count).astype(int).tolist():
            for view in range(3):
                yield View(frame, view, drawn_substrate(name, 5))


def compare(bench: Bench, quality: str, sampling: ClothSampling, chosen: list[View]) -> None:
    """Print what a quality costs and how good it is."""
    by_texture: dict[Texture, list[npt.NDArray[np.float64]]] = {texture: [] for texture in COMPARED}
    by_view: dict[int, list[npt.NDArray[np.float64]]] = {view: [] for view in range(3)}
    floor: list[npt.NDArray[np.float64]] = []
    cycles, rest = [], []
    order = list(bench.pictures)
    for shot in chosen:
        pictures, light, other = bench.composed(shot, sampling)
        cycles.append(light)
        rest.append(other)
        for texture in COMPARED:
            window, reference = bench.reference(shot, texture)
            error = squared(pictures[order.index(texture)][window.slices], reference)
            cloth = bench.cloth(shot, window)
            by_texture[texture].append(error[cloth].ravel())
            by_view[shot.view].append(error[cloth].ravel())
            floor.append(error[~cloth].ravel())
    everything = [error for errors in by_texture.values() for error in errors]
    seconds = (np.median(cycles) + np.median(rest)) / len(order)
    textures = " ".join(
        f"{texture} {decibels(errors):.1f}" for texture, errors in by_texture.items()
    )
    views = " ".join(
        f"{bench.rig[view].name} {decibels(errors):.1f}"
        for view, errors in by_view.items()
        if errors
    )
    print(
        f"{quality:18} {seconds:.4f} CPU s; cloth {decibels(everything):.2f} dB ({textures}; "
        f"{views}); floor near it "
        f"{decibels(floor):.1f} dB; Cycles {1e3 * np.median(cycles):.0f} ms, all else "
        f"{1e3 * np.median(rest):.0f} ms "
        f"({100 * np.median(rest) / np.median(cycles):.1f} %)",
        flush=True,
    )


def cost_of_looks(bench: Bench, chosen: list[View]) -> None:
    """Print the cost of a shading and its composition, with a plain sheet and with all looks."""
    full, plain = bench.look, replace(bench.look, hem=0.0, translucency=0.0)
    seconds: dict[str, list[float]] = {"plain": [], "full": []}
    for _ in range(3):
        for view in chosen:
            for name, look, creases in (("plain", plain, 0.0), ("full", full, CREASES)):
                bench.look = look
                bench.geometry.surface.apply_relief(hem=1e-3 * look.hem, creases=creases, seed=1)
                _, light, other = bench.composed(view, CLOTH_SAMPLING[Quality.standard])
                seconds[name].append(light + other)
    ratio = np.median(np.array(seconds["full"]) / np.array(seconds["plain"])) - 1
    print(
        f"looks: {1e3 * np.median(seconds['plain']):.0f} ms plain, "
        f"{1e3 * np.median(seconds['full']):.0f} ms with hem, "
        f"thickness, translucency and creases: {100 * ratio:+.1f} % (median of {len(chosen) * 3} "
        "pairs)",
        flush=True,
    )


def cost_of_ground_truth(bench: Bench, chosen: list[View]) -> None:
    """Print the cost of ground truth, and of a shading.

    Ground truth is depth, segmentation, normals, texture coordinates and flow.
    """
    pictures, known, written = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        context = RenderContext(folder)
        for view in chosen * 2:
            _, light, other = bench.composed(view, CLOTH_SAMPLING[Quality.standard])
            pictures.append(light + other)
            now, then = (
                bench.geometry.points(bench.track[k], k) for k in (view.frame, view.frame - 5)
            )
            start = time.process_time()
            truth = ground_truth(bench.geometry, now, then, bench.rig[view.view])
            end_of_measurement = time.process_time()
            for values in vars(truth).values():
                context.chunk(values)
            known.append(end_of_measurement - start)
            written.append(time.process_time() - end_of_measurement)
    whole = np.array(pictures)
    of_trace, of_all = (
        100 * np.median(part / whole) for part in (np.array(known), np.add(known, written))
    )
    print(
        f"ground truth: {1e3 * np.median(known):.0f} ms a frame, {of_trace:.1f} % of the "
        f"{1e3 * np.median(whole):.0f} ms of a shading and its eight pictures; {of_all:.1f} % with "
        "writing it",
        flush=True,
    )


def whole_clips(trajectory: Path, out: Path, **look_of_clip: Any) -> None:
    """Make the clips of a task, all of it, and print where the time goes."""
    with np.load(trajectory) as file:
        record = {
            "positions": file["track"][None],
            "rest": file["rest"][None],
            "triangles": file["triangles"][None],
        }
    spent = [0.0, 0.0]  # in Blender, and for all
    rendered = FrameReader._rendered

    def timed(*arguments: Any) -> Any:
        start = time.process_time()
        result = rendered(*arguments)
        spent[0] += time.process_time() - start
        return result

    FrameReader._rendered = timed  # type: ignore[assignment, method-assign]
    look = ClothDragRender(
        rig="drag",
        rig_digest=rig_digest("drag"),
        texture=TEXTURES[0],
        instants=shown_frames(30, len(record["positions"][0])),
        light_seed=3,
        crease_seed=1,
        **look_of_clip,
    )
    with tempfile.TemporaryDirectory() as folder:
        store = DirectoryStore(folder)
        data = io.BytesIO()
        np.savez(data, **record)
        reference = RecordRef(digest=store.publish(data.getvalue()), row=0)
        actor = RenderActor(folder)
        short = look.model_copy(update={"instants": look.instants[:1]})
        for document, wanted in (
            (short, ()),
            (look, TEXTURES),
        ):  # shaders are compiled once, with the first
            task = RenderTask(render=document, record=reference, textures=wanted)
            spent = [0.0, 0.0]
            start = time.process_time()
            result = TaskResult.model_validate(actor.render(task.model_dump(mode="json")))
            spent[1] = time.process_time() - start
        assert isinstance(result.output, RenderOutput)
        shape = (len(TEXTURES), len(look.instants), 224, 224, 3)
        clips = np.empty(shape, dtype=np.uint8)
        labels = []
        for clip, clip_result in zip(clips, result.output.clips.values(), strict=True):
            assert isinstance(clip_result.output, RenderOutput), clip_result.message
            where = clip_result.output.chunks["video"]
            labels.append(clip_result.output.labels["psnr_cloth"])
            decode_clip(store.read(where.digest, offset=where.offset, length=where.length), clip)
    np.save(out, clips)
    blender, every = spent
    print(
        f"{', '.join(map(str, look_of_clip.values()))}: {every / (shape[0] * shape[1]):.4f} CPU s "
        "per frame and "
        f"texture; Blender {blender:.2f} s, all else {every - blender:.2f} s "
        f"({100 * (every / blender - 1):.1f} %); "
        f"PSNR {labels}",
        flush=True,
    )


def parse_options() -> argparse.Namespace:
    """Return the options of the command line."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("trajectory", type=Path)
    arguments.add_argument("--frames", type=int, default=12, help="instants, each in three views")
    arguments.add_argument("--references", type=Path, help="folder that keeps them")
    arguments.add_argument(
        "--substrates", action="store_true", help="the seven of the thesis, one instant each"
    )
    arguments.add_argument(
        "--clip", type=Path, metavar="NPY", help="make whole clips instead, and write them there"
    )
    arguments.add_argument("--quality", default="standard", help="of --clip")
    arguments.add_argument("--substrate", default="matt", help="of --clip")
    arguments.add_argument("--material", default=MATERIAL, help="of --clip")
    arguments.add_argument("--viewpoint", default="calibrated", help="of --clip")
    arguments.add_argument("--creases", type=float, default=CREASES, help="of --clip")
    arguments.add_argument("--direct", action="store_true", help="direct renderings too")
    arguments.add_argument("--look", action="store_true", help="only what the look of cloth costs")
    arguments.add_argument(
        "--ground-truth", action="store_true", help="only what ground truth costs"
    )
    arguments.add_argument(
        "--also", nargs="*", default=[], metavar="FRAME+WINDOW", help="other samplings"
    )
    return arguments.parse_args()


def compare_direct(bench: Bench, chosen: list[View]) -> None:
    """Print the cost and the error of direct renderings, without the composition of textures."""
    for samples in (16, 32):
        errors, seconds = [], []
        for view in chosen[:6]:
            picture, spent = bench.direct(view, Texture.floral, Sampling(samples, "guided"))
            part, reference = bench.reference(view, Texture.floral)
            errors.append(squared(picture[part.slices], reference)[bench.cloth(view, part)].ravel())
            seconds.append(spent)
        print(
            f"direct {samples:11} {np.median(seconds):.4f} CPU s; cloth {decibels(errors):.2f} "
            "dB (floral)",
            flush=True,
        )


def main() -> None:
    """Compare the qualities, or print one of the costs that an option asks for."""
    options = parse_options()
    if options.clip is not None:
        names = ("quality", "material", "viewpoint", "substrate", "creases")
        whole_clips(
            options.trajectory, options.clip, **{name: getattr(options, name) for name in names}
        )
        return

    bench = Bench(options.trajectory, options.references)
    app = import_bpy().app
    print(f"bpy {app.version_string} ({app.build_hash.decode()}), {platform.machine()}, one thread")
    qualities = {str(quality): sampling for quality, sampling in CLOTH_SAMPLING.items()}
    for pair in options.also:
        frame, window = map(int, pair.split("+"))
        qualities[pair] = ClothSampling(frame, window, (0.0, 0.0, 0.0))
    chosen = list(shots(bench.track, options.frames, ("matt",)))
    bench.composed(chosen[0], CLOTH_SAMPLING[Quality.draft])  # shaders are compiled once
    if options.look or options.ground_truth:
        if options.look:
            cost_of_looks(bench, chosen)
        if options.ground_truth:
            cost_of_ground_truth(bench, chosen)
        return
    for quality, sampling in qualities.items():
        compare(bench, quality, sampling, chosen)
    if options.direct:
        compare_direct(bench, chosen)
    if options.substrates:
        for name in HARD:
            compare(
                bench, name, CLOTH_SAMPLING[Quality.standard], list(shots(bench.track, 1, (name,)))
            )


if __name__ == "__main__":
    main()
