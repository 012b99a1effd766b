"""Render a set of rods from all four cameras.

Runs in Blender's interpreter:  .venv-blender/bin/python benchmarks/render_rod_set.py RODS.npz
VIEWS.npz

RODS.npz has `centerline` (rods, 150, 3) over L; VIEWS.npz gets `views` (rods, cameras, height,
width, 3) besides. The color of rod number i is that of seed i.
"""

import argparse
from pathlib import Path

import numpy as np
from stickslip_blender.scenes.rod_hang import RodRenderer, silicone_color
from stickslip_schemas.spec.cameras import load_rig
from stickslip_schemas.spec.jobs import Quality


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("rods", type=Path)
    arguments.add_argument("views", type=Path)
    arguments.add_argument("--rig", default="rod-4")
    arguments.add_argument("--quality", type=Quality, default=Quality.standard)
    options = arguments.parse_args()

    with np.load(options.rods) as file:
        rods = dict(file)
    rig = load_rig(options.rig)
    renderer = RodRenderer(quality=options.quality)
    views = [
        renderer.render(line, rig, color=silicone_color(seed))
        for seed, line in enumerate(rods["centerline"])
    ]
    np.savez_compressed(options.views, **rods, views=np.stack(views))


if __name__ == "__main__":
    main()
