"""Render clips of packed simulations with Blender, to test a network on another renderer.

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
from clip_draws import ClipDraws, label, looks
from stickslip_blender.cloth.clips import ClothRenderer
from stickslip_blender.cloth.geometry import Holders
from stickslip_blender.cloth.textures import texture_image
from stickslip_schemas.spec.cameras import load_rig


def parsed_arguments() -> argparse.Namespace:
    """Return the command line."""
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
    return parser.parse_args()


def draws_of(args: argparse.Namespace, instants: list[int]) -> ClipDraws:
    """Return the draws that a command line asks for; `instants` are those of the runs."""
    finish = None
    if args.albedo is not None:
        finish = {"albedo": tuple(args.albedo), "roughness": (0.4, 0.9), "grain": args.grain}
    return ClipDraws(
        seed=args.seed,
        clips=args.clips,
        textures=args.textures,
        only=args.only,
        instants=instants if args.instants == ["all"] else list(map(int, args.instants)),
        quality=args.quality,
        held_out_textures=args.held_out_textures,
        held_out_viewpoints=args.held_out_viewpoints,
        lighting=args.lighting,
        substrate=args.substrate,
        finish=finish,
    )


class PackedRuns:
    """Simulations of one mesh, from a file of `cloth_runs.py --pack`."""

    def __init__(self, path: Path) -> None:
        with np.load(path) as file:
            self.rest = file["rest"]
            self.triangles = file["triangles"].astype(np.int32)
            self.instants = file["instants"].tolist()
            self.about = [json.loads(str(line)) for line in file["about"]]
            low, high = file["differences"]
        # Differences of positions, low and high bytes apart, in steps of 10 um.
        differences = np.stack([low, high], axis=-1).view(np.int16)[..., 0]
        self.positions = np.cumsum(differences, axis=1, dtype=np.int16) * 1e-5
        """(runs, instants, vertices, 3) [m]"""


def main() -> None:
    """Render, and write videos and their true values."""
    args = parsed_arguments()
    runs = PackedRuns(args.runs)
    cameras = {camera.name: camera for camera in load_rig("drag")}
    renderer = ClothRenderer(runs.triangles, runs.rest, Holders)
    videos: list[Any] = []
    segmentations: list[Any] = []
    truths: list[dict[str, Any]] = []
    draws = draws_of(args, runs.instants)
    instants = draws.instants
    for look in looks(draws, runs.about):
        document = look.document
        frames = [runs.instants.index(instant) for instant in instants]
        camera = cameras[document.viewpoint]
        clip = renderer.clip(document, camera, runs.positions[look.run][frames])
        # One shading serves all textures.
        pictures = [texture_image(texture) for texture in look.textures]
        videos += list(clip.clips(clip.shading(), pictures)[0])
        if args.segmentation:
            segmentation = clip.ground_truth(["segmentation"])["segmentation"]
            segmentations += len(pictures) * [segmentation]
        for texture in look.textures:
            truth = label(look, texture, draws, runs.about)
            truths.append(truth)
            print(json.dumps(truth), flush=True)
    arrays: dict[str, Any] = {
        "video": np.stack(videos),
        "instants": np.array(instants, np.int16),
        "about": np.array([json.dumps(truth) for truth in truths]),
    }
    if segmentations:
        arrays["segmentation"] = np.stack(segmentations)
    np.savez_compressed(args.out, **arrays)


if __name__ == "__main__":
    main()
