"""Certificates and single samples of scenes, made by the workers' program on this machine.

The core is not imported here: the program writes files.
"""

import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, TypeAdapter, ValidationError
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.documents.tasks import SimulateOutput, SimulateTask, TaskResult
from stickslip_schemas.kinds.cloth_scene import ClothSceneSpec
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.library import built_in_files
from stickslip_schemas.store import Store, open_store

from stickslip_services.errors import CommandError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

DOCUMENT_NAME = "certificate.json"
RESULT_NAME = "scene.json"
TRAJECTORY_NAME = "trajectory.npz"


def _run_workers(arguments: list[str], refusal: str) -> str:
    """Run the workers' program and return what it printed.

    Raise CommandError where it made nothing.
    """
    # The matrices of master curves are too small for the threads of NumPy's linear algebra.
    environment = {"OPENBLAS_NUM_THREADS": "1", **os.environ}
    command = [sys.executable, "-m", "stickslip_workers", *arguments]
    try:
        ended = subprocess.run(
            command, env=environment, stdout=subprocess.PIPE, text=True, check=False
        )
    except OSError as error:
        raise CommandError(f"the workers' program does not start: {error}") from error
    if ended.returncode not in (0, 1) or not ended.stdout.strip():
        raise CommandError(f"{refusal}: the workers' program ended with status {ended.returncode}")
    return ended.stdout


def measure(preset: str, out: Path, *, quick: bool) -> Certificate:
    """Run the protocols of a preset and write the certificate into `out`.

    Progress goes to standard error.

    Raises CommandError where the program failed, or `out` holds another certificate.
    """
    arguments = ["certify", "--preset", preset, "--out", str(out), *(["--quick"] if quick else [])]
    digest = _run_workers(arguments, "no certificate was made").strip()
    certificate = read_certificate(out)
    if certificate.digest != digest:
        raise CommandError(
            f"{out} holds another certificate than the one just made; is somebody else writing "
            "there?"
        )
    return certificate


def read_certificate(directory: Path) -> Certificate:
    """Read a certificate from the directory that `measure` wrote; raise CommandError."""
    try:
        return Certificate.model_validate_json((directory / DOCUMENT_NAME).read_bytes())
    except FileNotFoundError as error:
        raise CommandError(
            f"{directory} holds no certificate: there is no {DOCUMENT_NAME}"
        ) from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "the document"
        raise CommandError(
            f"{directory / DOCUMENT_NAME} is not a valid certificate: {place}: {first['msg']}"
        ) from error


def simulate(
    spec: ClothSceneSpec,
    files: Mapping[str, bytes],
    out: Path,
    *,
    certificate: Certificate | None,
    obj: bool,
) -> dict[str, Any]:
    """Simulate the first sample of a spec into a new directory, with progress on standard error.

    `files` are those that it names, by digest. `out`, which must not exist, appears when all is
    written; with `obj`, it has `SHEET/0000.obj` and so on, too. Returns what `scene.json` holds;
    raises CommandError where it was not run.
    """
    import numpy as np  # the extra `arrays`

    if out.exists():
        raise CommandError(f"out: must not exist, and {out} does")
    build = _workers(["describe"])["builds"][spec.kind]["sim_core"]
    reason = why_uncertified(spec, certificate, build)
    if reason and spec.needs_certificate:
        hint = f"`stickslip certify --preset {spec.certified_preset}` makes one"
        raise CommandError(f"{reason}; {hint}")
    first_point = next(iter(spec.grid()))
    task = SimulateTask(simulation=spec.simulation(first_point))
    with _written(task, files) as (arguments, store):
        result = TaskResult.model_validate(_workers(["replay", *arguments]))
        if result.outcome == "failed":
            raise CommandError(f"the scene was not simulated: {result.message}")
        # A rejected sample has no output.
        labels: dict[str, Any] = {}
        arrays: dict[str, Any] = {}
        if isinstance(result.output, SimulateOutput):
            labels = dict(result.output.labels)
            record = result.output.record
            with np.load(io.BytesIO(store.read(record.digest)), allow_pickle=False) as columns:
                arrays = {name: values[record.row] for name, values in columns.items()}
    summary = {
        "scene": spec.stage.model_dump(mode="json"),
        "digest": spec.stage.digest,
        "solver": build,
        "certified": not reason,
        "certificate": None if reason or certificate is None else certificate.digest,
        "why_not_certified": reason,
        "valid": result.outcome == "succeeded",
        "reason": result.message,
        "labels": labels,
    }
    # The directory appears when it is complete.
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        _write(partial, spec, arrays, summary, obj=obj)
        partial.chmod(0o755)
        partial.rename(out)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return summary


def preview(scene: Scene, files: Mapping[str, bytes], out: Path) -> list[str]:
    """Draw the start and the motions of a scene into a directory.

    Return names of pictures, or raise CommandError.
    """
    with _written(scene, files) as (arguments, _):
        answer = _workers(["preview", *arguments, "--out", str(out)])
    pictures: list[str] = answer["pictures"]
    return pictures


def fit(
    scene: Scene, files: Mapping[str, bytes], observations: Path, request: Mapping[str, Any]
) -> dict[str, Any]:
    """Fit parameters of a scene to observations of it; raise CommandError.

    `observations` is an NPZ file, and `request` has the options of the workers' program.
    """
    if not observations.is_file():
        raise CommandError(f"there is no file {observations}")
    with _written(scene, files) as (arguments, _):
        options = ["--observations", str(observations), "--request", json.dumps(request)]
        return _workers(["fit", *arguments, *options], "nothing was fitted")


@contextmanager
def _written(document: BaseModel, files: Mapping[str, bytes]) -> Iterator[tuple[list[str], Store]]:
    """Write a document and the files that it names.

    Yield the arguments that name them, and their store.
    """
    # A store of its own, since a coordinator may be using that of the data directory.
    with tempfile.TemporaryDirectory(prefix="stickslip-scene-") as temporary:
        store = open_store(temporary)
        for data in (*files.values(), *built_in_files().values()):
            store.publish(data)
        path = Path(temporary, "document.json")
        path.write_text(document.model_dump_json(), encoding="utf-8")
        yield [str(path), "--store", temporary], store


def run_lab(request: Mapping[str, Any]) -> dict[str, Any]:
    """Run a test of the textile laboratory, and return its result; raise CommandError.

    The request has the test, the fabric and options, as the workers' program takes them.
    """
    with tempfile.TemporaryDirectory(prefix="stickslip-lab-") as temporary:
        path = Path(temporary, "request.json")
        path.write_text(json.dumps(request), encoding="utf-8")
        return _workers(["lab", str(path)], "the fabric was not tested")


def measure_photographs(request: Mapping[str, Any]) -> dict[str, Any]:
    """Measure threads in photographs, and return the result; raise CommandError.

    The request is that of the workers' program.
    """
    for name in request["photographs"]:
        if not Path(name).is_file():
            raise CommandError(f"there is no file {name}")
    refusal = "the photographs were not measured"
    return _workers(["rods", json.dumps(request)], refusal)


def why_uncertified(spec: ClothSceneSpec, certificate: Certificate | None, build: str) -> str:
    """Return why no certificate vouches for the samples of a spec, or an empty text.

    `build` is that of the solver.
    """
    preset = spec.certified_preset
    if certificate is None:
        return f"there is no certificate of preset {preset}"
    if certificate.preset != preset:
        return f"the certificate is of preset {certificate.preset}, and the scene has {preset}"
    if not certificate.passed:
        return "the preset did not pass its protocols"
    if not certificate.certifies:
        return "the certificate is a quick one"
    if certificate.sim_core != build:
        return "the certificate is of another build of the solver"
    measured = {report.protocol for report in certificate.protocols}
    missing = [name for name in spec.certified_protocols if name not in measured]
    return f"the certificate lacks what the scene needs: {', '.join(missing)}" if missing else ""


def _workers(
    arguments: list[str], refusal: str = "nothing was made of the scene"
) -> dict[str, Any]:
    """Run the workers' program and return its answer, which is JSON; see `_run_workers`."""
    answer: dict[str, Any] = json.loads(_run_workers(arguments, refusal))
    return answer


def _write(
    out: Path, spec: ClothSceneSpec, arrays: dict[str, Any], summary: dict[str, Any], *, obj: bool
) -> None:
    """Write the summary, the arrays and, with `obj`, a folder of OBJ files for each sheet."""
    import numpy as np

    # pydantic writes null for numbers that are not finite, as JSON asks.
    document = TypeAdapter(dict[str, Any]).dump_json(summary, indent=2)
    (out / RESULT_NAME).write_bytes(document + b"\n")
    if not arrays:
        return
    times = np.arange(spec.instants) / spec.instants_per_second
    np.savez_compressed(out / TRAJECTORY_NAME, times=times, **arrays)
    if obj:
        for sheet in spec.stage.sheets:
            _write_obj(out / sheet, arrays[f"{sheet}.triangles"], arrays[f"{sheet}.positions"])


def _write_obj(
    folder: Path, triangles: "npt.NDArray[np.int64]", positions: "npt.NDArray[np.float64]"
) -> None:
    """Write an OBJ file for each instant of a sheet. OBJ counts vertices from 1."""
    folder.mkdir()
    faces = "".join(f"f {a} {b} {c}\n" for a, b, c in (triangles + 1).tolist())
    for frame, vertices in enumerate(positions.tolist()):
        moved = "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices)
        (folder / f"{frame:04d}.obj").write_text(moved + faces, encoding="ascii")
