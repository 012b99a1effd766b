"""Moving pictures of the kinds of cloth that touches itself, other cloth, and a body that turns.

    .venv/bin/python tools/cloth_animations.py simulate DIR [NAME ...]
    .venv-blender/bin/python tools/cloth_animations.py render DIR OUT [NAME ...]

The first command writes trajectories to DIR. The second renders them as a worker does, but 320 pixels wide, and writes
them to OUT. It made docs/figures/cloth-drag.webp, cloth-on-cloth.webp and cloth-sphere.webp; it makes shawl.webp, too.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

SIDE = 320
"""Of the pictures [px]."""

FRAMES = 75
"""Of each, evenly spread over the instants that are shown."""

SHOWN: Mapping[str, tuple[int, int]] = {"cloth-drag": (88, 198), "cloth-on-cloth": (0, 120)}
"""The first instant and the one after the last, where those are not all: the hem turns over where the holders turn."""

QUALITY = 75
"""Of the WebP, 1 to 100."""

VERTICES = 31
COARSER = 21
"""Of a mesh along a side; the coarser one is that of cloth on cloth."""

LOOKS: Mapping[str, Mapping[str, Any]] = {
    "cloth-drag": {
        "kind": "cloth_drag",
        "rig": "drag",
        "material": "camel-ponte-roma",
        "texture": "stripes",
        "viewpoint": "left",
        "substrate": "ceramic",
    },
    "cloth-on-cloth": {
        "kind": "cloth_on_cloth",
        "rig": "drag",
        "material": "gray-interlock",
        "texture": "gingham",
        "viewpoint": "left",
        "substrate": "cloth",
    },
    "cloth-sphere": {
        "kind": "cloth_sphere",
        "rig": "sphere-3",
        "material": "gray-interlock",
        "texture": "checker",
        "viewpoint": "front",
    },
    "shawl": {
        "kind": "shawl",
        "rig": "shawl-3",
        "material": "gray-interlock",
        "texture": "plaid",
        "viewpoint": "side",
    },
}

PROPS = ("skin_rest", "skin_weights", "skin_triangles", "bones", "sphere_pose")
"""What a run of a shawl has besides the cloth."""

ZOOM: Mapping[str, float] = {"cloth-drag": 1.3, "cloth-on-cloth": 1.1, "cloth-sphere": 1.6}
"""How many times larger the middle of the picture is than the rig's camera shows it, where that is not once."""


def simulate(folder: Path, names: list[str]) -> None:
    """Simulate, and write what renderers take."""
    from stickslip_sim_core.scenes import cloth_drag, cloth_on_cloth, cloth_sphere, shawl

    made: Mapping[str, Callable[[str], Any]] = {
        "cloth-drag": lambda material: cloth_drag.scene(material, 0.9, mesh=VERTICES, seed=1).run(),
        "cloth-on-cloth": lambda material: cloth_on_cloth.scene(
            material, material, 0.4, mesh=COARSER, frames=SHOWN["cloth-on-cloth"][1], seed=1
        ).run(),
        "cloth-sphere": lambda material: cloth_sphere.scene(material, 0.4, angular_speed=1.5, mesh=VERTICES).run(),
        "shawl": lambda material: shawl.scene(material, 0.5, mesh=VERTICES).run(),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        begin = time.process_time()
        run = made[name](LOOKS[name]["material"])
        sys.stdout.write(
            f"{name}: {time.process_time() - begin:.0f} CPU s, {run.unconverged_steps} of {run.steps} steps "
            f"unconverged, {(run.self_intersections > 0).sum()} of {len(run.positions)} frames cross\n"
        )
        if not run.valid:
            raise SystemExit(f"{name} is not valid: {run.reason}")
        np.savez(
            folder / f"{name}.npz",
            positions=run.positions[None].astype(np.float32),
            rest=run.rest[None],
            triangles=run.triangles[None],
            **{part: run.record[part][None] for part in PROPS if part in run.record},
        )


def render(folder: Path, out: Path, names: list[str]) -> None:
    """Render what was simulated, by the worker's actor, and write moving pictures."""
    from stickslip_blender.actor import RenderActor
    from stickslip_schemas.documents.tasks import RecordRef, RenderOutput, RenderTask, TaskResult
    from stickslip_schemas.format.codecs import decode_clip
    from stickslip_schemas.format.pictures import moving
    from stickslip_schemas.kinds import kind_named
    from stickslip_schemas.spec.appearance import shown_frames
    from stickslip_schemas.spec.cameras import load_rig, rig_digest
    from stickslip_schemas.store import DirectoryStore

    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as store_folder:
        store = DirectoryStore(store_folder)
        actor = RenderActor(store_folder)
        for name in names:
            look = dict(LOOKS[name])
            record = (folder / f"{name}.npz").read_bytes()
            with np.load(folder / f"{name}.npz") as file:
                first, end = SHOWN.get(name, (0, file["positions"].shape[1]))
            camera = next(camera for camera in load_rig(look["rig"]) if camera.name == look["viewpoint"])
            scale = ZOOM.get(name, 1.0) * SIDE / camera.width
            larger = camera.model_copy(
                update={
                    "width": SIDE,
                    "height": SIDE,
                    "fx": scale * camera.fx,
                    "fy": scale * camera.fy,
                    "cx": 0.5 * (SIDE - 1) + scale * (camera.cx - 0.5 * (camera.width - 1)),
                    "cy": 0.5 * (SIDE - 1) + scale * (camera.cy - 0.5 * (camera.height - 1)),
                }
            )
            document = kind_named(look["kind"]).render_type.model_validate(
                {
                    **look,
                    "rig_digest": rig_digest(look["rig"]),
                    "camera": larger,
                    "quality": "draft",
                    "instants": [first + instant for instant in shown_frames(FRAMES, end - first)],
                    "light_seed": 3,
                    "crease_seed": 1,
                }
            )
            task = RenderTask(render=document, record=RecordRef(digest=store.publish(record), row=0))
            result = TaskResult.model_validate(actor.render(task.model_dump(mode="json")))
            if not isinstance(result.output, RenderOutput):
                raise SystemExit(f"{name}: {result}")
            clip = np.empty((FRAMES, larger.height, larger.width, 3), dtype=np.uint8)
            where = result.output.chunks["video"]
            decode_clip(store.read(where.digest, offset=where.offset, length=where.length), clip)
            data = moving(clip, side=SIDE, quality=QUALITY)
            (out / f"{name}.webp").write_bytes(data)
            sys.stdout.write(f"{name}: {len(data) / 1e3:.0f} kB\n")


def main() -> None:
    """Do one of both."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    commands = arguments.add_subparsers(dest="command", required=True)
    for command in ("simulate", "render"):
        parser = commands.add_parser(command)
        parser.add_argument("folder", type=Path)
        if command == "render":
            parser.add_argument("out", type=Path)
        parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(LOOKS)}; none: all")
    options = arguments.parse_args()
    names = options.names or list(LOOKS)
    for name in names:
        if name not in LOOKS:
            arguments.error(f"NAME: must be of {', '.join(LOOKS)}, got {name}")
    if options.command == "simulate":
        simulate(options.folder, names)
    else:
        render(options.folder, options.out, names)


if __name__ == "__main__":
    main()
