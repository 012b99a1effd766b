"""Render clips of packed simulations with Blender, to test a network on a renderer that it has not
seen.

    $BLENDER_PY benchmarks/training/blender_clips.py RUNS.npz CLIPS.npz [--clips 24] [--seed 0]
    [--only RUN ...]

RUNS.npz is of `cloth_runs.py --pack`. Only the instants of `--instants` are rendered. Every clip
has a viewpoint and a light of its own. One shading serves its `--textures` textures. The runs, or
those of `--only`, take turns.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from stickslip_blender.cloth.clips import ClothRenderer
from stickslip_blender.cloth.geometry import Holders
from stickslip_blender.cloth.textures import texture_image
from stickslip_schemas.kinds.cloth_drag import VIEWPOINTS, ClothDragRender
from stickslip_schemas.spec.cameras import load_rig
from stickslip_schemas.spec.jobs import Quality
from stickslip_schemas.spec.names import Texture


def main() -> None:
    """Render, and write videos and what is true of them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--clips", type=int, default=24, help="shadings; clips are so many times the textures"
    )
    parser.add_argument("--textures", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--only", type=int, nargs="+", help="numbers of the runs; all, if not given"
    )
    parser.add_argument(
        "--instants",
        nargs="+",
        default=["60", "80", "130", "150", "210", "220"],
        help="or all that the runs hold",
    )
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--held-out-textures", action="store_true")
    parser.add_argument("--held-out-viewpoints", action="store_true")
    parser.add_argument("--lighting", default="drawn", help="drawn or held-out")
    parser.add_argument("--substrate", default="matt", help="floor: a built-in one")
    parser.add_argument(
        "--albedo", type=float, nargs=2, metavar=("LOW", "HIGH"), help="of a floor of one's own"
    )
    parser.add_argument(
        "--grain", type=float, default=0.1, help="contrast of the marks on a floor of one's own"
    )
    parser.add_argument(
        "--segmentation", action="store_true", help="write the segmentation of every pixel, too"
    )
    args = parser.parse_args()
    with np.load(args.runs) as file:
        low, high = file["differences"]
        positions = (
            np.cumsum(np.stack([low, high], axis=-1).view(np.int16)[..., 0], axis=1, dtype=np.int16)
            * 1e-5
        )
        rest, triangles, instants = (
            file["rest"],
            file["triangles"].astype(np.int32),
            file["instants"].tolist(),
        )
        about = [json.loads(str(line)) for line in file["about"]]
    shown = instants if args.instants == ["all"] else [int(instant) for instant in args.instants]
    frames = [instants.index(instant) for instant in shown]
    runs = list(range(len(about))) if args.only is None else args.only
    textures = list(Texture)[-4:] if args.held_out_textures else list(Texture)[:-4]
    views = VIEWPOINTS[3:] if args.held_out_viewpoints else VIEWPOINTS[:3]
    cameras = {camera.name: camera for camera in load_rig("drag")}
    random = np.random.default_rng(args.seed)
    own = None
    if args.albedo is not None:
        own = {"albedo": tuple(args.albedo), "roughness": (0.4, 0.9), "grain": args.grain}
    floor = {"substrate": args.substrate, "finish": own}
    renderer = ClothRenderer(triangles, rest, Holders)
    videos, seen, told = [], [], []
    for clip in range(args.clips):
        run, view = runs[clip % len(runs)], views[clip % len(views)]
        chosen = [textures[place] for place in random.permutation(len(textures))[: args.textures]]
        look = ClothDragRender.model_validate(
            {
                "material": about[run]["material"],
                "texture": chosen[0],
                "viewpoint": view,
                "lighting": args.lighting,
                **floor,
                "quality": Quality(args.quality),
                "rig": "drag",
                "rig_digest": "0" * 64,
                "instants": tuple(shown),
                "light_seed": int(random.integers(2**31)),
                "crease_seed": int(random.integers(2**31)),
            }
        )
        made = renderer.clip(look, cameras[view], positions[run][frames])
        videos += list(
            made.clips(made.shading(), [texture_image(texture) for texture in chosen])[0]
        )
        if args.segmentation:
            seen += len(chosen) * [made.ground_truth(["segmentation"])["segmentation"]]
        for texture in chosen:
            told.append(
                {"run": run, "viewpoint": view, "texture": texture.value, **floor, **about[run]}
            )
            print(json.dumps(told[-1]), flush=True)
    arrays: dict[str, Any] = {
        "video": np.stack(videos),
        "instants": np.array(shown, np.int16),
        "about": np.array([json.dumps(line) for line in told]),
    }
    if seen:
        arrays["segmentation"] = np.stack(seen)
    np.savez_compressed(args.out, **arrays)


if __name__ == "__main__":
    main()
