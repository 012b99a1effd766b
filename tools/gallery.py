"""Pictures of the built-in scenes, by the stages of the queue: four instants side by side.

    .venv/bin/python tools/gallery.py [SCENE ...] [--out pictures] [--views] [--axis NAME=VALUE ...]
                                      [--set PATH=VALUE ...] [--record FILE]

Simulates one sample of each scene with its default parameters, and renders it from the camera
`high`, or from all with --views, one below the other. --record takes the arrays of a sample that
`benchmarks/scenes.py --keep` has simulated. No coordinator is needed, but the environment of
Blender is.
"""

import argparse
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml
from PIL import Image
from stickslip_schemas.documents.tasks import (
    RecordRef,
    RenderOutput,
    RenderTask,
    SimulateOutput,
    SimulateTask,
)
from stickslip_schemas.format.codecs import decode_clip
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.scene.library import built_in_files, load_scene, scene_names
from stickslip_schemas.spec.cameras import FRAMING
from stickslip_schemas.spec.resolution import DEFAULT_RESOLUTION
from stickslip_schemas.store import open_store
from stickslip_workers.commands import replay

INSTANTS = 4
VIEW = "high"
"""A camera that all built-in scenes have."""
SIDE = 160
"""Of a picture [px]."""
BLENDER_PYTHON = Path(sys.prefix).parent / ".venv-blender/bin/python"


def strip(
    name: str, axes: dict[str, Any], change: dict[str, Any], *, all_views: bool, record: Path | None
) -> Any:
    """Return pictures of a sample of a scene, from one camera or from all: (height, width, 3)."""
    cameras = load_scene(name).looks.cameras
    views = list(cameras) if isinstance(cameras, dict) else list(FRAMING)
    spec = job_spec_adapter.validate_python(
        {
            "kind": "cloth_scene",
            "scene": name,
            "set": change,
            "frames": INSTANTS,
            "quality": "draft",
            "allow_uncertified": True,
            "axes": {"texture": "checker", "viewpoint": views if all_views else VIEW, **axes},
        }
    )
    points = list(spec.grid())
    with TemporaryDirectory(prefix="stickslip-gallery-") as store:
        for data in built_in_files().values():
            open_store(store).publish(data)
        if record is None:
            done = replay(
                SimulateTask(simulation=spec.simulation(points[0])),
                store=store,
                blender_python=BLENDER_PYTHON,
            )
            if not isinstance(done.output, SimulateOutput):
                sys.exit(f"{name}: {done.message}")
            record_ref = done.output.record
        else:
            with np.load(record) as arrays, (Path(store) / "record.npz").open("wb") as file:
                np.savez(
                    file,
                    allow_pickle=False,
                    **{key: values[None] for key, values in arrays.items()},
                )
            record_ref = RecordRef(
                digest=open_store(store).publish((Path(store) / "record.npz").read_bytes()), row=0
            )
        return np.concatenate(
            [
                _clip(RenderTask(render=spec.render(point), record=record_ref), store)
                for point in points
            ]
        )


def _clip(task: RenderTask, store: str) -> npt.NDArray[np.uint8]:
    """Return the frames of a clip side by side."""
    result = replay(task, store=store, blender_python=BLENDER_PYTHON)
    if not isinstance(result.output, RenderOutput):
        sys.exit(f"not rendered: {result.message}")
    width, height = DEFAULT_RESOLUTION
    video = np.empty((INSTANTS, height, width, 3), np.uint8)
    decode_clip(open_store(store).read(result.output.chunks["video"].digest), video)
    return np.concatenate(list(video), axis=1)


def main() -> None:
    """Write a WebP file for each scene."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    arguments.add_argument("scenes", nargs="*", default=scene_names())
    arguments.add_argument("--out", type=Path, default=Path("pictures"))
    arguments.add_argument("--views", action="store_true", help="all cameras, one below the other")
    arguments.add_argument("--axis", nargs="*", default=[], metavar="NAME=VALUE")
    arguments.add_argument("--set", nargs="*", default=[], metavar="PATH=VALUE")
    arguments.add_argument(
        "--record", type=Path, help="arrays of a sample that was simulated before"
    )
    options = arguments.parse_args()
    axes, change = (
        {k: yaml.safe_load(v) for k, v in (entry.split("=", 1) for entry in entries)}
        for entries in (options.axis, options.set)
    )
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.scenes:
        begin = time.perf_counter()
        pixels = strip(name, axes, change, all_views=options.views, record=options.record)
        picture = Image.fromarray(pixels)
        small = picture.resize(
            (INSTANTS * SIDE, picture.height * SIDE // DEFAULT_RESOLUTION[1]),
            Image.Resampling.LANCZOS,
        )
        path = options.out / f"{name}.webp"
        small.save(path, quality=70, method=6)
        sys.stdout.write(
            f"{path}: {path.stat().st_size / 1e3:.0f} kB, {time.perf_counter() - begin:.0f} s\n"
        )


if __name__ == "__main__":
    main()
