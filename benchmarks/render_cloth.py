"""What a frame of cloth costs in CPU time and how far it is from a 256-sample reference, by quality.

Runs in Blender's interpreter:  .venv-blender/bin/python benchmarks/render_cloth.py [--frames N] [--all]

PSNR is given twice: over the whole frame, most of which is dark floor, and over the pixels of the cloth. CPU time is
all of a frame (mesh, Cycles, denoiser, pixels out), the median over frames after a first one. Textures, viewpoints and
lights go round; the cloth is a made-up sheet of 41 x 41 vertices that trails over the floor.
"""

import argparse
import platform
import time
from dataclasses import dataclass
from itertools import cycle

import numpy as np
import numpy.typing as npt
from render_rods import psnr
from stickslip_blender.blender import import_bpy
from stickslip_blender.cloth import ClothRenderer, Light
from stickslip_blender.engine import CLOTH_SAMPLING, REFERENCE, Sampling
from stickslip_schemas.cameras import load_rig
from stickslip_schemas.textures import Texture

SIDE = 41

OTHERS = {
    f"{samples}{'' if denoiser == 'none' else ' ' + denoiser}": Sampling(samples=samples, denoiser=denoiser)
    for samples in (4, 8, 16, 32, 64)
    for denoiser in ("none", "fast")
}


@dataclass(frozen=True)
class Sheet:
    """A mesh and its positions, one for each frame."""

    triangles: npt.NDArray[np.int32]
    rest: npt.NDArray[np.float64]
    track: npt.NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """Frames, (frames, height, width, 3), and the median CPU time of one [ms]."""

    frames: npt.NDArray[np.uint8]
    milliseconds: float


def make_sheet(count: int) -> Sheet:
    """Drag a sheet with wrinkles of its own in every frame from x = 0 to 0.3 m."""
    line = np.linspace(-0.1, 0.1, SIDE)
    rest = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    number = np.arange(SIDE**2).reshape(SIDE, SIDE)
    a, b, c, d = (number[i : SIDE - 1 + i, j : SIDE - 1 + j].ravel() for i in (0, 1) for j in (0, 1))
    triangles = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)]).astype(np.int32)
    random = np.random.Generator(np.random.PCG64(0))
    below = 0.1 - rest[:, 1]
    hanging = np.minimum(below, 0.16)
    sag = 1.0 - (rest[:, 0] / 0.1) ** 2
    track = []
    for shift in np.linspace(0.0, 0.3, count):
        wave = sum(
            0.004 / n * np.sin(20.0 * n * rest[:, 0] + 15.0 * rest[:, 1] + phase)
            for n, phase in enumerate(random.uniform(0.0, 6.3, 4), start=1)
        )
        x = shift - 0.05 * hanging / 0.16 - (below - hanging) + wave * hanging / 0.16
        z = 0.15 * (1.0 - hanging / 0.16) * (1.0 - 0.35 * sag * np.exp(-below / 0.1)) + np.maximum(wave, 0.0) * 0.8
        track.append(np.stack([x, rest[:, 0], z], axis=1))
    return Sheet(triangles, rest, np.stack(track))


def measure(sampling: Sampling, sheet: Sheet) -> Measured:
    rig, textures, frames, seconds = load_rig("drag-3"), cycle(Texture), [], []
    with ClothRenderer(sheet.triangles, sheet.rest, quality=sampling) as renderer:
        for texture in Texture if sampling is not REFERENCE else ():  # the pictures are drawn once
            renderer.render(sheet.track[:1], rig[0], texture=texture, light=Light.drawn(0))
        for seed, positions in enumerate(sheet.track):
            start = time.process_time()
            camera, light = rig[seed % 3], Light.drawn(seed)
            frames.append(renderer.render(positions[None], camera, texture=next(textures), light=light)[0])
            seconds.append(time.process_time() - start)
    return Measured(np.stack(frames), 1e3 * float(np.median(seconds)))


def cloth_pixels(sheet: Sheet) -> npt.NDArray[np.bool_]:
    """Return which pixels the vertices, denser than pixels when halved twice, fall on, (frames, height, width)."""
    rig = load_rig("drag-3")
    masks = np.zeros((len(sheet.track), 224, 224), dtype=bool)
    for number, positions in enumerate(sheet.track):
        corners = positions[sheet.triangles]
        weights = [(i / 4, j / 4, 1 - (i + j) / 4) for i in range(5) for j in range(5 - i)]
        points = np.einsum("wk,tkx->twx", np.array(weights), corners).reshape(-1, 3)
        column, row = np.rint(rig[number % 3].project(points)[0]).astype(int).clip(0, 223).T
        masks[number, row, column] = True
    return masks


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--frames", type=int, default=16, help="how many frames")
    arguments.add_argument("--all", action="store_true", help="other samplings too, not only the named ones")
    options = arguments.parse_args()

    sheet = make_sheet(options.frames)
    reference = measure(REFERENCE, sheet)
    cloth = cloth_pixels(sheet)
    app = import_bpy().app
    print(f"bpy {app.version_string} ({app.build_hash.decode()}), {platform.machine()}, one thread")
    print(f"{options.frames} frames; the cloth covers {100 * cloth.mean():.1f} % of the pixels")
    print(f"{'quality':10} {'samples':>7} {'denoiser':>8} {'CPU ms/frame':>12} {'PSNR frame':>10} {'PSNR cloth':>10}")
    named: dict[str, Sampling] = {str(name): sampling for name, sampling in CLOTH_SAMPLING.items()}
    for name, sampling in (named | (OTHERS if options.all else {})).items():
        result = measure(sampling, sheet)
        quality = [psnr(result.frames, reference.frames), psnr(result.frames[cloth], reference.frames[cloth])]
        print(
            f"{name:10} {sampling.samples:7} {sampling.denoiser:>8} {result.milliseconds:12.0f} "
            f"{quality[0]:10.1f} {quality[1]:10.1f}",
            flush=True,
        )
    print(f"{'reference':10} {REFERENCE.samples:7} {REFERENCE.denoiser:>8} {reference.milliseconds:12.0f}")


if __name__ == "__main__":
    main()
