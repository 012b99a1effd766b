"""What the workers' program makes on this machine: certificates of its build, and single samples of
scenes.

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
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.documents.tasks import SimulateOutput, SimulateTask, TaskResult
from stickslip_schemas.kinds.cloth_scene import ClothSceneSpec
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.library import built_in_files
from stickslip_schemas.store import Store, open_store

from stickslip_services.errors import CommandError

DOCUMENT_NAME = "certificate.json"
RESULT_NAME = "scene.json"
TRAJECTORY_NAME = "trajectory.npz"


def _asked(arguments: list[str], refusal: str) -> str:
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
    digest = _asked(arguments, "no certificate was made").strip()
    certificate = read_certificate(out)
    if certificate.digest != digest:
        raise CommandError(
            f"{out} holds another certificate than the one just made; is somebody else writing there?"
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
    why = why_uncertified(spec, certificate, build)
    if why and spec.needs_certificate:
        raise CommandError(f"{why}; `stickslip certify --preset {spec.certified_preset}` makes one")
    task = SimulateTask(simulation=spec.simulation(next(iter(spec.grid()))))
    with _handed_over(task, files) as (given, store):
        result = TaskResult.model_validate(_workers(["replay", *given]))
        if result.outcome == "failed":
            raise CommandError(f"the scene was not simulated: {result.message}")
        arrays: dict[str, Any] = {}
        if isinstance(result.output, SimulateOutput):
            with np.load(
                io.BytesIO(store.read(result.output.record.digest)), allow_pickle=False
            ) as record:
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
    """Draw the start and the motions of a scene into a directory.

    Return names of pictures, or raise CommandError.
    """
    with _handed_over(scene, files) as (given, _):
        pictures: list[str] = _workers(["preview", *given, "--out", str(out)])["pictures"]
    return pictures


@contextmanager
def _handed_over(
    document: BaseModel, files: Mapping[str, bytes]
) -> Iterator[tuple[list[str], Store]]:
    """Write a document and the files that it names.

    Yield the arguments that name them, and their store.
    """
    with tempfile.TemporaryDirectory(prefix="stickslip-scene-") as temporary:
        store = open_store(temporary)
        for data in (*files.values(), *built_in_files().values()):
            store.publish(data)
        given = Path(temporary, "document.json")
        given.write_text(document.model_dump_json(), encoding="utf-8")
        yield [str(given), "--store", temporary], store


def why_uncertified(spec: ClothSceneSpec, certificate: Certificate | None, build: str) -> str:
    """Return why no certificate vouches for the samples of a spec with a build of the solver, or an
    empty text.
    """
    preset = spec.certified_preset
    if certificate is None:
        return f"there is no certificate of preset {preset}"
    if certificate.preset != preset:
        return f"the certificate is of preset {certificate.preset}, and the scene has {preset}"
    if not certificate.certifies:
        return (
            "the certificate is a quick one"
            if certificate.passed
            else "the preset did not pass its protocols"
        )
    if certificate.sim_core != build:
        return "the certificate is of another build of the solver"
    measured = {report.protocol for report in certificate.protocols}
    missing = [name for name in spec.certified_protocols if name not in measured]
    return f"the certificate lacks what the scene needs: {', '.join(missing)}" if missing else ""


def _workers(arguments: list[str]) -> dict[str, Any]:
    """Run the workers' program and return its answer, which is JSON."""
    answer: dict[str, Any] = json.loads(_asked(arguments, "nothing was made of the scene"))
    return answer


def _write(
    out: Path, spec: ClothSceneSpec, arrays: dict[str, Any], said: dict[str, Any], *, obj: bool
) -> None:
    import numpy as np

    # pydantic writes null for numbers that are not finite, as JSON asks.
    result = TypeAdapter(dict[str, Any]).dump_json(said, indent=2)
    (out / RESULT_NAME).write_bytes(result + b"\n")
    if not arrays:
        return
    times = np.arange(spec.instants) / spec.instants_per_second
    np.savez_compressed(out / TRAJECTORY_NAME, times=times, **arrays)
    for sheet in spec.stage.sheets if obj else ():
        (out / sheet).mkdir()
        faces = "".join(
            f"f {a} {b} {c}\n" for a, b, c in (arrays[f"{sheet}.triangles"] + 1).tolist()
        )
        for frame, vertices in enumerate(arrays[f"{sheet}.positions"].tolist()):
            moved = "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices)
            (out / sheet / f"{frame:04d}.obj").write_text(moved + faces, encoding="ascii")
