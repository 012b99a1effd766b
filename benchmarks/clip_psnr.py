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

import numpy as np
from stickslip_blender.cloth.clips import ClothRenderer
from stickslip_blender.cloth.geometry import Holders
from stickslip_blender.cloth.quality import errors, measured_group, pool_errors
from stickslip_blender.cloth.textures import texture_image
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.spec.arrays import shown_frames
from stickslip_schemas.spec.cameras import rig_cameras, rig_digest
from stickslip_schemas.spec.names import Texture
from stickslip_schemas.spec.resolution import DEFAULT_RESOLUTION

SHOWN = (
    ("left", "matt", "drawn", "21"),
    ("calibrated", "stainless-steel", "drawn", "22"),
    ("right", "cloth", "drawn", "23"),
)
TEXTURES = tuple(map(str, Texture))[:8]
LONG = 32  # paths per pixel of a shading, four in each of a picture


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


def main() -> None:
    options = parsed()
    with np.load(options.trajectory) as file:
        track = file["track"]
        renderer = ClothRenderer(file["triangles"], file["rest"], Holders)
    size = tuple(options.resolution)
    textures = TEXTURES[: options.textures]
    pictures = {str(name): texture_image(name) for name in Texture}
    for viewpoint, substrate, lighting, number in options.shown or SHOWN:
        seed = int(number)
        look = ClothDragRender(
            rig="drag",
            rig_digest=rig_digest("drag"),
            quality=options.quality,
            material=options.material,
            texture=textures[0],
            resolution=size,
            viewpoint=viewpoint,
            substrate=substrate,
            lighting=lighting,
            instants=shown_frames(options.frames, len(track)),
            light_seed=seed,
            crease_seed=1,
        )
        camera = next(camera for camera in rig_cameras("drag", size) if camera.name == viewpoint)
        clip = renderer.clip(look, camera, track[list(look.instants)])
        start = time.process_time()
        shading = clip.shading()
        videos, _ = clip.clips(shading, [pictures[name] for name in textures])
        made = time.process_time()
        groups = list(dict.fromkeys(map(measured_group, textures)))
        own = [
            list(
                clip.references([pictures[x] for x in g], clip.measured_frames(options.measured, g))
            )
            for g in groups
        ]
        weights, usual = clip.weights(shading)
        ended = time.process_time()
        others = replace(clip, seed=seed + 5000)
        instants = range(options.first, options.frames, options.every)
        long = list(others.references([pictures[name] for name in groups[0]], instants, LONG))
        seconds = (made - start) / len(textures) / options.frames
        print(
            f"{viewpoint}, {substrate}, {lighting}: {seconds:.4f} CPU s a frame and texture",
            end=", ",
        )
        print(
            f"measuring {100 * (ended - made) / (made - start):.0f} % more, at {len(own[0])} "
            "instants",
            flush=True,
        )
        for channel, name in enumerate(groups[0]):
            if name not in textures:
                continue
            video = videos[textures.index(name)]
            stated = pool_errors(
                [(errors(video[f], lit, channel), weights[f]) for f, lit in own[0]], usual
            )
            found = pool_errors(
                [(errors(video[f], lit, channel), weights[f] > 0.0) for f, lit in long]
            )
            said = zip(stated.psnr, stated.deviations, found.psnr, strict=True)
            print(
                f"  {name}:",
                "; ".join(f"{a:.1f} +- {d:.1f} against {b:.1f}" for a, d, b in said),
                flush=True,
            )


if __name__ == "__main__":
    main()
