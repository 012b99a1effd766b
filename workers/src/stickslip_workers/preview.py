"""A scene before it is simulated: its bodies and holders at all times, handed to the renderer to be drawn."""

import json
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base import referred
from stickslip_schemas.kinds.cloth.arrays import scene_segments
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.files import with_arrays
from stickslip_schemas.scene.parameters import with_values
from stickslip_schemas.spec.cameras import load_rig
from stickslip_schemas.store import Store
from stickslip_sim_core.scenes import cloth_scene
from stickslip_sim_core.scenes.scene import ClothRun

FRAMES = 24
"""Of the animation."""


def preview(scene: Scene, store: Store, out: Path, blender_python: Path) -> list[str]:
    """Draw the start and the motions of a scene; return the names of the pictures: of each camera, and an animation.

    Cloth is not simulated: it stays as it starts. A sheet that starts hung is drawn flat.

    `store` has the files that it names; `out`, a directory, is made where it does not exist. Raises ValueError, whose
    message begins with the place of the wrong value, OSError, or RuntimeError where the drawing failed.
    """
    given = scene.looks.cameras
    views = [view.camera(name) for name, view in given.items()] if isinstance(given, dict) else []
    cameras = load_rig(given) if isinstance(given, str) else views
    with TemporaryDirectory(prefix="stickslip-preview-") as folder:
        pictures = {place: Path(folder, referred(name) or "") for place, name in scene.files() if place[0] == "looks"}
        for path in pictures.values():
            path.write_bytes(store.read(path.name))
        request = {
            "scene": with_values(scene.staged(), {place: str(path) for place, path in pictures.items()}),
            "sheet": scene.textured,
            "segments": scene_segments(scene.sheets, scene.bodies),
            "cameras": [camera.model_dump(mode="json") for camera in cameras],
        }
        record, document = Path(folder, "record.npz"), Path(folder, "scene.json")
        np.savez(record, allow_pickle=False, **_record(scene, with_arrays(scene, store.read)))
        document.write_text(json.dumps(request), encoding="utf-8")
        out.mkdir(parents=True, exist_ok=True)
        command = [str(blender_python), "-m", "stickslip_blender.preview", str(record), str(document), str(out)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"the drawing failed: {done.stderr[-2000:]}")
    return done.stdout.split()


def _record(scene: Scene, document: dict[str, Any]) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of a scene at the times of the animation."""
    for sheet in document["sheets"].values():
        if sheet["start"]["type"] == "hung":
            sheet["start"] = {"type": "flat"}
    made = cloth_scene.scene(document)
    times = np.linspace(0.0, (scene.frames - 1) / scene.frame_rate, FRAMES).tolist()
    start = SimpleNamespace(positions=np.repeat(made.start[None], FRAMES, axis=0))
    tracks = {name: np.stack([np.asarray(at(time)) for time in times]) for name, at in made.tracks.items()}
    return {**made.arrays(cast(ClothRun, start)), **made.record, **tracks}
