"""One sample of a scene, made here by the workers' program with the stages of the queue."""

import io
import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.documents.tasks import SimulateOutput, SimulateTask, TaskResult
from stickslip_schemas.kinds.cloth_scene import ClothSceneSpec
from stickslip_schemas.plan.grid import grid
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.library import built_in_files
from stickslip_schemas.store import open_store

from stickslip_services.errors import CommandError
from stickslip_services.local.certifying import ask_workers

RESULT_NAME = "scene.json"
TRAJECTORY_NAME = "trajectory.npz"


class SimulateError(CommandError):
    """The scene was not simulated."""


def simulate(
    spec: ClothSceneSpec, files: Mapping[str, bytes], out: Path, *, certificate: Certificate | None, obj: bool
) -> dict[str, Any]:
    """Simulate the first sample of a spec into a new directory, with progress on standard error.

    Args:
        spec: Of a scene.
        files: What it names, by digest.
        out: A directory that does not exist; it appears when all is written.
        certificate: Of its preset.
        obj: Write `SHEET/0000.obj` and so on, too.

    Returns:
        What `scene.json` holds.

    Raises:
        SimulateError: It was not run.
    """
    import numpy as np  # the extra `arrays`

    if out.exists():
        raise SimulateError(f"out: must not exist, and {out} does")
    build = _workers(["describe"])["builds"][spec.kind]["sim_core"]
    why = why_uncertified(spec, certificate, build)
    if why and spec.needs_certificate:
        raise SimulateError(f"{why}; `stickslip certify --preset {spec.certified_preset}` makes one")
    with tempfile.TemporaryDirectory(prefix="stickslip-scene-") as temporary:
        store = open_store(temporary)
        for data in (*files.values(), *built_in_files().values()):
            store.publish(data)
        task = SimulateTask(simulation=spec.simulation(next(iter(grid(spec)))))
        given = Path(temporary, "task.json")
        given.write_text(task.model_dump_json(), encoding="utf-8")
        result = TaskResult.model_validate(_workers(["replay", str(given), "--store", temporary]))
        if result.outcome == "failed":
            raise SimulateError(f"the scene was not simulated: {result.message}")
        arrays: dict[str, Any] = {}
        if isinstance(result.output, SimulateOutput):
            with np.load(io.BytesIO(store.read(result.output.record.digest)), allow_pickle=False) as record:
                arrays = {name: values[result.output.record.row] for name, values in record.items()}
    said = {
        "scene": spec.stage.model_dump(mode="json"),
        "digest": spec.stage.digest,
        "solver": build,
        "certified": not why,
        "certificate": None if why or certificate is None else certificate.digest,
        "why_not_certified": why,
        "valid": result.outcome == "succeeded",
        "reason": result.message,
        "labels": result.output.labels if isinstance(result.output, SimulateOutput) else {},
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        _write(partial, spec, arrays, said, obj=obj)
        partial.chmod(0o755)
        partial.rename(out)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return said


def preview(scene: Scene, files: Mapping[str, bytes], out: Path) -> list[str]:
    """Draw the start and the motions of a scene into a directory; return the names of the pictures.

    Raises:
        SimulateError: It was not drawn.
    """
    with tempfile.TemporaryDirectory(prefix="stickslip-scene-") as temporary:
        store = open_store(temporary)
        for data in (*files.values(), *built_in_files().values()):
            store.publish(data)
        given = Path(temporary, "scene.json")
        given.write_text(scene.model_dump_json(), encoding="utf-8")
        said = _workers(["preview", str(given), "--store", temporary, "--out", str(out)])
    pictures: list[str] = said["pictures"]
    return pictures


def why_uncertified(spec: ClothSceneSpec, certificate: Certificate | None, build: str) -> str:
    """Return why no certificate vouches for the samples of a spec with a build of the solver, or an empty text."""
    preset = spec.certified_preset
    if certificate is None:
        return f"there is no certificate of preset {preset}"
    if certificate.preset != preset:
        return f"the certificate is of preset {certificate.preset}, and the scene has {preset}"
    if not certificate.certifies:
        return "the certificate is a quick one" if certificate.passed else "the preset did not pass its protocols"
    if certificate.sim_core != build:
        return "the certificate is of another build of the solver"
    measured = {report.protocol for report in certificate.protocols}
    missing = [name for name in spec.certified_protocols if name not in measured]
    return f"the certificate lacks what the scene needs: {', '.join(missing)}" if missing else ""


def _workers(arguments: list[str]) -> dict[str, Any]:
    """Run the workers' program and return its answer, which is JSON."""
    answer: dict[str, Any] = json.loads(ask_workers(arguments, "nothing was made of the scene", SimulateError))
    return answer


def _write(out: Path, spec: ClothSceneSpec, arrays: dict[str, Any], said: dict[str, Any], *, obj: bool) -> None:
    import numpy as np

    (out / RESULT_NAME).write_text(json.dumps(said, indent=2) + "\n", encoding="utf-8")
    if not arrays:
        return
    times = np.arange(spec.instants) / spec.instants_per_second
    np.savez_compressed(out / TRAJECTORY_NAME, times=times, **arrays)
    for sheet in spec.stage.sheets if obj else ():
        (out / sheet).mkdir()
        faces = "".join(f"f {a} {b} {c}\n" for a, b, c in (arrays[f"{sheet}.triangles"] + 1).tolist())
        for frame, vertices in enumerate(arrays[f"{sheet}.positions"].tolist()):
            moved = "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices)
            (out / sheet / f"{frame:04d}.obj").write_text(moved + faces, encoding="ascii")
