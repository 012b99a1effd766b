"""Where the torch renderer and Blender see cloth: the share of what either sees that both see (IoU).

    $BLENDER_PY benchmarks/training/blender_clips.py RUNS.npz CLIPS.npz --textures 1 --segmentation
    python benchmarks/training/silhouette_agreement.py RUNS.npz CLIPS.npz

RUNS.npz is of `cloth_runs.py --pack`. Cloth is where it covers half of a pixel or more, in whole pictures of 224 x 224
px. Pixels of the holders, which the torch renderer does not draw, are left out.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from stickslip_schemas.spec.cameras import load_rig
from stickslip_training.cloth.render import silhouettes
from stickslip_training.cloth.runs import load_runs
from stickslip_training.cloth.training import RIG, frames_at

CLOTH, HOLDERS = 2, 3
"""Codes of the segmentation."""


def main() -> None:
    """Compare, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path)
    parser.add_argument("clips", type=Path)
    args = parser.parse_args()
    runs = load_runs(args.runs)
    named = {camera.name: camera for camera in load_rig(RIG)}
    with np.load(args.clips) as file:
        seen, shown = file["segmentation"], tuple(map(int, file["instants"]))
        about = [json.loads(str(line)) for line in file["about"]]
    frames, _ = frames_at(runs.instants, shown, 0)
    shares = []
    for clip, labels in zip(about, seen, strict=True):
        meshes = torch.from_numpy(runs.positions[clip["run"], frames])
        ours = silhouettes(meshes, named[clip["viewpoint"]], points=200).numpy() >= 0.5
        theirs, asked = labels == CLOTH, labels != HOLDERS
        shares += list((ours & theirs & asked).sum(axis=(1, 2)) / ((ours | theirs) & asked).sum(axis=(1, 2)))
    print(
        f"{len(shares)} pictures of {len(about)} clips: IoU {np.mean(shares):.3f} in the mean, "
        f"median {np.median(shares):.3f}, least {min(shares):.3f}"
    )


if __name__ == "__main__":
    main()
