"""Render clips of packed simulations with Blender, to test a network on another renderer.

    $BLENDER_PY benchmarks/training/blender_clips.py RUNS.npz CLIPS.npz [--clips 24] [--seed 0]
    [--only RUN ...]

RUNS.npz is of `cloth_runs.py --pack`. Only the instants of `--instants` are rendered. Every clip
has a viewpoint and a light of its own. One shading serves its `--textures` textures. The runs, or
those of `--only`, take turns.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Look:
    """One clip to render, with several textures."""

    run: int
    textures: list[Texture]
    document: ClothDragRender


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


def looks(args: argparse.Namespace, runs: PackedRuns) -> Iterator[Look]:
    """Yield the look of each clip: runs and viewpoints in turn, all else at random."""
    numbers = args.only or list(range(len(runs.about)))
    textures = list(Texture)[-4:] if args.held_out_textures else list(Texture)[:-4]
    viewpoints = VIEWPOINTS[3:] if args.held_out_viewpoints else VIEWPOINTS[:3]
    instants = runs.instants if args.instants == ["all"] else list(map(int, args.instants))
    finish = None
    if args.albedo is not None:
        finish = {"albedo": tuple(args.albedo), "roughness": (0.4, 0.9), "grain": args.grain}
    random = np.random.default_rng(args.seed)
    for clip in range(args.clips):
        run = numbers[clip % len(numbers)]
        # The order of these draws is part of what a seed means.
        chosen = [textures[index] for index in random.permutation(len(textures))[: args.textures]]
        document = {
            "material": runs.about[run]["material"],
            "texture": chosen[0],
            "viewpoint": viewpoints[clip % len(viewpoints)],
            "lighting": args.lighting,
            "substrate": args.substrate,
            "finish": finish,
            "quality": Quality(args.quality),
            "rig": "drag",
            "rig_digest": "0" * 64,
            "instants": tuple(instants),
            "light_seed": int(random.integers(2**31)),
            "crease_seed": int(random.integers(2**31)),
        }
        yield Look(run, chosen, ClothDragRender.model_validate(document))


def main() -> None:
    """Render, and write videos and their true values."""
    args = parsed_arguments()
    runs = PackedRuns(args.runs)
    cameras = {camera.name: camera for camera in load_rig("drag")}
    renderer = ClothRenderer(runs.triangles, runs.rest, Holders)
    videos: list[Any] = []
    segmentations: list[Any] = []
    truths: list[dict[str, Any]] = []
    instants: tuple[int, ...] = ()
    for look in looks(args, runs):
        document = look.document
        instants = document.instants
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
            truth = {
                "run": look.run,
                "viewpoint": document.viewpoint,
                "texture": texture.value,
                "substrate": args.substrate,
                "finish": document.finish and document.finish.model_dump(),
                **runs.about[look.run],
            }
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
