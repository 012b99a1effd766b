"""How much memory a render process gains over many frames: it must not have to be started again for it.

    .venv-blender/bin/python benchmarks/render_memory.py /tmp/cloth.npz [--frames 2000]

Frames are 32 x 32, so that it takes a minute or two: what could leak is made for a frame, a clip or a view, whatever
its size. Every clip has 20 frames, another view, lamp, floor and texture, and the gate's direct rendering.
"""

import argparse
from pathlib import Path

import numpy as np
from stickslip_blender.clips import ClothRenderer
from stickslip_blender.holders import Holders
from stickslip_blender.textures import texture_image
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.spec.cameras import Camera, load_rig, rig_digest
from stickslip_schemas.spec.fabrics import Texture

LENGTH = 20
SIDE = 32
WARM_UP = 10  # clips


def resident() -> int:
    """Return the memory that the process has in use [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def small(camera: Camera) -> Camera:
    """Return a camera that sees the same in fewer pixels."""
    share = SIDE / camera.width
    numbers = {name: getattr(camera, name) * share for name in ("fx", "fy")}
    numbers |= {name: (getattr(camera, name) + 0.5) * share - 0.5 for name in ("cx", "cy")}
    return camera.model_copy(update=numbers | {"width": SIDE, "height": SIDE})


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("trajectory", type=Path)
    arguments.add_argument("--frames", type=int, default=2000, help="after the warm-up")
    options = arguments.parse_args()
    with np.load(options.trajectory) as file:
        track = file["track"][:: max(len(file["track"]) // LENGTH, 1)][:LENGTH]
        renderer = ClothRenderer(file["triangles"], file["rest"], Holders)
    rig = load_rig("drag")
    begun = 0
    for number in range(WARM_UP + options.frames // LENGTH):
        camera = rig[number % len(rig)]
        look = ClothDragRender(
            rig="drag",
            rig_digest=rig_digest("drag"),
            quality="preview",
            material="gray-interlock",
            texture="floral",
            viewpoint=camera.name,
            substrate="any",
            creases=0.5,
            instants=tuple(range(LENGTH)),
            light_seed=number,
            crease_seed=number,
        )
        clip = renderer.clip(look, small(camera), track)
        clip.clips(clip.shading(), [texture_image(list(Texture)[number % len(Texture)])])
        if number + 1 == WARM_UP:
            begun = resident()
    ended = resident()
    print(
        f"{options.frames} frames: {begun / 1e6:.1f} to {ended / 1e6:.1f} MB, {100 * (ended / begun - 1):+.2f} % after "
        f"{WARM_UP * LENGTH} to warm up"
    )


if __name__ == "__main__":
    main()
