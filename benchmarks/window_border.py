"""The step in a clip of cloth where the window that has more paths ends, on a plain floor.

Runs in Blender's interpreter, on a trajectory that `benchmarks/render_trajectory.py` has written:

    .venv-blender/bin/python benchmarks/window_border.py /tmp/cloth.npz [--quality standard]

The light itself changes there: what is compared is the difference to a direct rendering of 32
paths, denoised. Its mean over 4 px inside the border, 6 to 10 px away from the cloth, minus that
over 4 px outside it, is the step of a side.
"""

import argparse
from pathlib import Path

import numpy as np
import numpy.typing as npt
from stickslip_blender.cloth.clips import ClothRenderer
from stickslip_blender.cloth.geometry import GROUND, Holders
from stickslip_blender.cloth.textures import texture_image
from stickslip_blender.cycles.engine import Sampling
from stickslip_blender.cycles.pixels import encode
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.spec.arrays import shown_frames
from stickslip_schemas.spec.cameras import load_rig, rig_digest
from stickslip_schemas.spec.names import Texture

VIEWS = (("left", "matt", 61), ("calibrated", "matt", 62), ("right", "white-table", 63))
FRAMES, MARGIN, WIDTH, PATHS = 30, 10, 4, 32


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("trajectory", type=Path)
    arguments.add_argument("--quality", default="standard")
    arguments.add_argument("--every", type=int, default=1, help="take one of so many frames")
    options = arguments.parse_args()
    with np.load(options.trajectory) as file:
        track = file["track"]
        renderer = ClothRenderer(file["triangles"], file["rest"], Holders)
    picture = texture_image(Texture.checker)
    for viewpoint, substrate, seed in VIEWS:
        instants = shown_frames(FRAMES, len(track))[:: options.every]
        look = ClothDragRender(
            rig="drag",
            rig_digest=rig_digest("drag"),
            quality=options.quality,
            material="gray-interlock",
            texture="checker",
            viewpoint=viewpoint,
            substrate=substrate,
            instants=instants,
            light_seed=seed,
            crease_seed=1,
        )
        camera = next(camera for camera in load_rig("drag") if camera.name == viewpoint)
        clip = renderer.clip(look, camera, track[list(instants)])
        object.__setattr__(clip, "floor", np.ones_like(clip.floor))
        (video,), _ = clip.clips(clip.shading(), [picture])
        segments = clip.ground_truth(["segmentation"])["segmentation"]
        sides: dict[str, list[list[npt.NDArray[np.float64]]]] = {
            name: [[], []] for name in ("left", "right", "above", "below")
        }
        for shot, frame, codes in zip(clip.frames, video, segments, strict=True):
            direct = clip.scene.direct(shot, picture, Sampling(PATHS, "plain", seed + 1000))
            off = frame[..., 1].astype(float) - encode(direct.astype(np.float32))[..., 1]
            off[codes != GROUND] = np.nan
            window = clip.scene.window(shot, MARGIN)
            rows, columns = window.slices
            for name, at, step, size in (
                ("left", window.left, 1, camera.width),
                ("right", window.right, -1, camera.width),
                ("above", window.top, 1, camera.height),
                ("below", window.bottom, -1, camera.height),
            ):
                if not WIDTH <= at <= size - WIDTH:
                    continue
                for side, first in enumerate((at, at - WIDTH) if step > 0 else (at - WIDTH, at)):
                    part = slice(first, first + WIDTH)
                    there = (rows, part) if name in ("left", "right") else (part, columns)
                    sides[name][side].append(off[there].ravel())
        steps = {
            name: np.nanmean(np.concatenate(inside)) - np.nanmean(np.concatenate(outside))
            for name, (inside, outside) in sides.items()
            if inside
        }
        text = ", ".join(f"{name} {step:+.2f}" for name, step in steps.items())
        print(
            f"{viewpoint}, {substrate}: largest {max(map(abs, steps.values())):.2f} levels; {text}",
            flush=True,
        )


if __name__ == "__main__":
    main()
