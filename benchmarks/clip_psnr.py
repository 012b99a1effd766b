"""The stated PSNR of clips of cloth, against longer references at other instants.

The script also prints the cost of both.

Runs in Blender's interpreter, on a trajectory that `benchmarks/render_trajectory.py` has written:

    .venv-blender/bin/python benchmarks/clip_psnr.py /tmp/cloth.npz [--material gray-interlock]
        [--quality standard] [--resolution 640 480] [--frames 30] [--textures 8]
        [--first 2] [--every 4] [--shown left matt drawn 21 [--shown ...]]

Each clip has 30 frames and eight textures, or fewer of large pictures. `--shown` names viewpoint,
floor, lighting and seed of a clip; without it, three are shown. The longer references are 3 x 128
paths per pixel and 6 x 128 of landed cloth, not denoised, at every fourth instant, for three of the
textures; they share no noise with a clip's own.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from stickslip_blender.cloth.clips import ClipRenderer, ClothRenderer
from stickslip_blender.cloth.geometry import Holders
from stickslip_blender.cloth.quality import errors, measured_group, pool_errors
from stickslip_blender.cloth.textures import texture_image
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.spec.arrays import shown_frames
from stickslip_schemas.spec.cameras import rig_cameras, rig_digest
from stickslip_schemas.spec.names import Texture
from stickslip_schemas.spec.resolution import DEFAULT_RESOLUTION

VIEWS = (
    ("left", "matt", "drawn", "21"),
    ("calibrated", "stainless-steel", "drawn", "22"),
    ("right", "cloth", "drawn", "23"),
)
TEXTURES = tuple(map(str, Texture))[:8]
LONG = 32  # paths per pixel of a shading, four in each of a picture


View = tuple[str, str, str, int]
"""Viewpoint, floor, lighting and seed of a clip."""


def parsed() -> argparse.Namespace:
    """Return the options of the command line."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("trajectory", type=Path)
    arguments.add_argument("--material", default="gray-interlock")
    arguments.add_argument("--quality", default="standard")
    arguments.add_argument("--measured", type=float, default=0.5)
    arguments.add_argument("--resolution", type=int, nargs=2, default=DEFAULT_RESOLUTION)
    arguments.add_argument("--frames", type=int, default=30)
    arguments.add_argument("--textures", type=int, default=len(TEXTURES))
    arguments.add_argument("--first", type=int, default=2, help="frame of the first reference")
    arguments.add_argument("--every", type=int, default=4, help="frames between references")
    arguments.add_argument(
        "--shown", nargs=4, action="append", metavar=("VIEWPOINT", "FLOOR", "LIGHTING", "SEED")
    )
    return arguments.parse_args()


def settings(view: View, options: argparse.Namespace, frame_count: int) -> ClothDragRender:
    """Return the render document of a clip of a trajectory with `frame_count` frames."""
    viewpoint, substrate, lighting, seed = view
    return ClothDragRender(
        rig="drag",
        rig_digest=rig_digest("drag"),
        quality=options.quality,
        material=options.material,
        texture=TEXTURES[0],
        resolution=tuple(options.resolution),
        viewpoint=viewpoint,
        substrate=substrate,
        lighting=lighting,
        instants=shown_frames(options.frames, frame_count),
        light_seed=seed,
        crease_seed=1,
    )


def compare(view: View, clip: ClipRenderer, options: argparse.Namespace) -> None:
    """Print what a clip costs, and the PSNR that it states beside that of longer references."""
    textures = TEXTURES[: options.textures]
    pictures = {str(name): texture_image(name) for name in Texture}
    start = time.process_time()
    shading = clip.shading()
    videos, _ = clip.clips(shading, [pictures[name] for name in textures])
    rendered = time.process_time() - start

    # The clip measures itself, a group of textures at a time.
    groups = list(dict.fromkeys(map(measured_group, textures)))
    references: list[list[Any]] = []
    for group in groups:
        frames = clip.measured_frames(options.measured, group)
        references.append(list(clip.references([pictures[name] for name in group], frames)))
    weights, mean_weights = clip.weights(shading)
    measuring = time.process_time() - start - rendered
    seconds = rendered / len(textures) / options.frames
    print(
        f"{', '.join(view[:3])}: {seconds:.4f} CPU s a frame and texture, measuring "
        f"{100 * measuring / rendered:.0f} % more, at {len(references[0])} instants",
        flush=True,
    )

    # Other seeds draw other paths, so these references share no noise with the clip.
    fresh_clip = replace(clip, seed=view[3] + 5000)
    instants = range(options.first, options.frames, options.every)
    long = list(fresh_clip.references([pictures[name] for name in groups[0]], instants, LONG))
    for channel, name in enumerate(groups[0]):
        if name not in textures:
            continue
        video = videos[textures.index(name)]
        stated = pool_errors(
            [
                (errors(video[frame], light, channel), weights[frame])
                for frame, light in references[0]
            ],
            mean_weights,
            options.frames,
        )
        measured = pool_errors(
            [(errors(video[frame], light, channel), weights[frame] > 0.0) for frame, light in long]
        )
        regions = zip(stated.psnr, stated.deviations, measured.psnr, strict=True)
        texts = [f"{psnr:.1f} +- {sigma:.1f} against {truth:.1f}" for psnr, sigma, truth in regions]
        print(f"  {name}:", "; ".join(texts), flush=True)


def main() -> None:
    """Compare the clips of some views."""
    options = parsed()
    with np.load(options.trajectory) as file:
        track = file["track"]
        renderer = ClothRenderer(file["triangles"], file["rest"], Holders)
    cameras = {camera.name: camera for camera in rig_cameras("drag", tuple(options.resolution))}
    for viewpoint, substrate, lighting, seed in options.shown or VIEWS:
        view = (viewpoint, substrate, lighting, int(seed))
        document = settings(view, options, len(track))
        instants = list(document.instants)
        compare(view, renderer.clip(document, cameras[viewpoint], track[instants]), options)


if __name__ == "__main__":
    main()
