"""Commands that need no Ray and no coordinator: replay a task, draw a scene, certify a preset."""

import json
import logging
import os
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base import Reason, artifact_digest, canonical_json, content_key
from stickslip_schemas.documents.certificate import Certificate, ProtocolReport
from stickslip_schemas.documents.tasks import AnyTask, RenderTask, TaskResult
from stickslip_schemas.kinds.cloth.arrays import scene_segments
from stickslip_schemas.plan.builds import digests, sources
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.files import with_arrays
from stickslip_schemas.scene.parameters import with_values
from stickslip_schemas.spec.cameras import Camera, load_rig
from stickslip_schemas.store import Store, open_store, write_durably
from stickslip_sim_core import build_info, protocols
from stickslip_sim_core.protocols.result import dense_master
from stickslip_sim_core.scenes import cloth_scene
from stickslip_sim_core.scenes.scene import ClothRun

from stickslip_workers.builds import solver_build
from stickslip_workers.settings import RENDER_ACTOR
from stickslip_workers.stages.run import failed, run_tasks

log = logging.getLogger(__name__)

# This script runs in Blender's interpreter. The answer goes to a file, because Blender also writes
# to standard output.
_RENDER = """
import importlib, json, sys
factory, store, task, answer = sys.argv[1:]
module, name = factory.split(":")
actor = getattr(importlib.import_module(module), name)(store)
with open(task) as file:
    result = actor.render(json.load(file))
with open(answer, "w") as file:
    json.dump(result, file)
"""


def replay(
    task: AnyTask, *, store: str, blender_python: Path, render_actor: str = RENDER_ACTOR
) -> TaskResult:
    """Run a task, and return its result.

    A render runs in Blender's interpreter.
    """
    if not isinstance(task, RenderTask):
        return run_tasks([task], open_store(store))[0]
    with TemporaryDirectory() as scratch:
        request = Path(scratch, "task.json")
        answer = Path(scratch, "result.json")
        request.write_text(task.model_dump_json())
        command = [blender_python, "-c", _RENDER, render_actor, store, request, answer]
        status = subprocess.run([str(word) for word in command], check=False).returncode
        if status != 0:
            return failed(Reason.renderer_crash, f"the renderer ended with status {status}")
        return TaskResult.model_validate_json(answer.read_bytes())


FRAMES = 24
"""Number of frames of the animation."""


def preview(scene: Scene, store: Store, out: Path, blender_python: Path) -> list[str]:
    """Draw the start and the motions of a scene.

    Return the names of the pictures: one of each camera, and an animation.

    Cloth is not simulated: it stays as it starts. A sheet with a hung start is drawn flat.

    `store` has the files that the scene names. `out` is a directory, and is made if it does not
    exist.

    Raises:
        ValueError: The message begins with the place of the wrong value.
        OSError: A file cannot be read or written.
        RuntimeError: The drawing failed.
    """
    cameras = _cameras(scene)
    with TemporaryDirectory(prefix="stickslip-preview-") as folder:
        pictures = {
            place: Path(folder, artifact_digest(name) or "")
            for place, name in scene.files()
            if place[0] == "looks"
        }
        for path in pictures.values():
            path.write_bytes(store.read(path.name))
        request = {
            "scene": with_values(
                scene.staged(), {place: str(path) for place, path in pictures.items()}
            ),
            "sheet": scene.textured,
            "segments": scene_segments(scene.sheets, scene.bodies),
            "cameras": [camera.model_dump(mode="json") for camera in cameras],
        }
        record = Path(folder, "record.npz")
        document = Path(folder, "scene.json")
        np.savez(record, allow_pickle=False, **_record(scene, with_arrays(scene, store.read)))
        document.write_text(json.dumps(request), encoding="utf-8")
        out.mkdir(parents=True, exist_ok=True)
        command = [
            str(blender_python),
            "-m",
            "stickslip_blender.preview",
            str(record),
            str(document),
            str(out),
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"the drawing failed: {done.stderr[-2000:]}")
    return done.stdout.split()


def _cameras(scene: Scene) -> Sequence[Camera]:
    """Return the cameras of a scene, which names a rig or describes its views."""
    cameras = scene.looks.cameras
    if isinstance(cameras, str):
        return load_rig(cameras)
    if cameras is None:
        return []
    return [view.camera(name) for name, view in cameras.items()]


def _record(scene: Scene, document: dict[str, Any]) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of a scene at the times of the animation."""
    for sheet in document["sheets"].values():
        if sheet["start"]["type"] == "hung":
            sheet["start"] = {"type": "flat"}
    staged = cloth_scene.scene(document)
    times = np.linspace(0.0, (scene.frames - 1) / scene.frame_rate, FRAMES).tolist()
    positions = np.repeat(staged.start[None], FRAMES, axis=0)
    # Nothing is simulated, so there are no derivatives.
    start = SimpleNamespace(positions=positions, sensitivities={})
    tracks = {}
    for name, value_at in staged.tracks.items():
        tracks[name] = np.stack([np.asarray(value_at(time)) for time in times])
    return {**staged.arrays(cast(ClothRun, start)), **staged.record, **tracks}


DOCUMENT_NAME = "certificate.json"

Say = Callable[[str], None]


def certify(preset: str, out: Path, *, quick: bool, say: Say) -> Certificate:
    """Certify a preset: write `certificate.json` into `out`.

    A protocol that raises has not passed, and the other protocols still run. Raises ValueError for
    an unknown preset.
    """
    if preset not in protocols.CERTIFICATION:
        raise ValueError(
            f"preset: must be one of {', '.join(protocols.CERTIFICATION)}, got {preset!r}"
        )
    certification = protocols.CERTIFICATION[preset]
    environment = _environment()
    reports: list[ProtocolReport] = []
    for number, name in enumerate(certification.protocols, 1):
        say(f"{number}/{len(certification.protocols)} {name} ...")
        cpu_start = time.process_time()
        wall_start = time.monotonic()
        try:
            result = protocols.run(
                name, preset, **(certification.quick.get(name, {}) if quick else {})
            )
            document = result.as_dict()
            for curve_document, curve in zip(document["curves"], result.curves, strict=True):
                dense_x, dense_y = dense_master(result.protocol, curve)
                curve_document["dense_x"] = dense_x.tolist()
                curve_document["dense_master"] = dense_y.tolist()
            report = ProtocolReport.model_validate(document)
            canonical_json(report.model_dump(mode="json"))  # settings are free in form
        # Any error becomes part of the certificate, and the other protocols still run.
        except Exception as error:
            log.exception("the protocol %s broke off", name)
            report = _broken_off(name, error)
        reports.append(report)
        cpu_seconds = time.process_time() - cpu_start
        wall_seconds = time.monotonic() - wall_start
        environment[f"cpu_seconds/{name}"] = f"{cpu_seconds:.2f}"
        say(f"    {verdict(report)}; {cpu_seconds:.1f} CPU s in {wall_seconds:.1f} s")
    certificate = Certificate(
        preset=preset,
        numbers=dict(certification.numbers()),
        sim_core=solver_build(certification.solver),
        protocol_sources=content_key(
            "protocols", digests(sources(["stickslip_sim_core.protocols"]))
        ),
        extent="quick" if quick else "full",
        protocols=tuple(reports),
        passed=all(report.passed for report in reports),
        environment=environment,
    )
    out.mkdir(parents=True, exist_ok=True)
    write_durably(out / DOCUMENT_NAME, certificate.canonical())
    return certificate


def verdict(report: ProtocolReport) -> str:
    """Return one line with the verdict on a protocol and its largest error."""
    if report.message:
        return f"broke off: {report.message}"
    error = "infinite" if report.error is None else f"{report.error:.1e}"
    word = "passed" if report.passed else "FAILED"
    return f"{word}, largest error {error} of {report.tolerance:g} allowed"


def _broken_off(name: str, error: Exception) -> ProtocolReport:
    return ProtocolReport(
        protocol=name,
        x="",
        y="",
        tolerance=0.0,
        error=None,
        passed=False,
        settings={},
        build_hash=build_info().build_hash,
        curves=(),
        message=f"{type(error).__name__}: {error}"[:2000],
    )


def _environment() -> dict[str, str]:
    build = build_info()
    return {
        "made_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "load": f"{os.getloadavg()[0]:.1f}",
        "python": platform.python_version(),
        "numpy": metadata.version("numpy"),
        "sim_core": build.version,
        "compiler": build.compiler,
        "isa": build.isa,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
