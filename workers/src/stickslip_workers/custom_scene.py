"""A custom scene: from its file to trajectories, with the same rule for certificates as for datasets."""

import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base.keys import content_key
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.spec.scene_file import Box, Cylinder, Key, MeshBody, Motion, Plane, SceneFile, Sphere
from stickslip_schemas.spec.scene_file import Sheet as SheetOfFile
from stickslip_sim_core import Body, Surface, box, custom_fabric, cylinder, fabric, plane, sphere
from stickslip_sim_core.cloth.meshes import Mesh, grid, unstructured
from stickslip_sim_core.protocols import CERTIFICATION, SCENE_PROTOCOLS
from stickslip_sim_core.scenes import custom
from stickslip_sim_core.scenes.custom import Sheet
from stickslip_sim_core.scenes.holders import Holder
from stickslip_sim_core.scenes.motions import Keyframes, MovingMesh, read_moving_mesh, rotation
from stickslip_sim_core.scenes.scene import ClothRun

from stickslip_workers.builds import solver_build

RESULT_NAME = "scene.json"
TRAJECTORY_NAME = "trajectory.npz"

Array = npt.NDArray[np.float64]

_STILL = Motion(keys=(Key(time=0.0),))


class SceneError(ValueError):
    """A scene that cannot be run, and why: field, rule and value."""


class NotCertifiedError(SceneError):
    """No certificate vouches for the preset of a scene with this build."""


def why_uncertified(scene: SceneFile, certificate: Certificate | None) -> str:
    """Return why a scene's trajectories are not certified, or an empty text.

    All sheets have self-contact and contact with each other, so the certificate has to have the protocols of contact.
    """
    preset = scene.preset.value
    if certificate is None:
        return f"there is no certificate of preset {preset}"
    if certificate.preset != preset:
        return f"the certificate is of preset {certificate.preset}, and the scene has {preset}"
    if not certificate.certifies:
        return "the certificate is a quick one" if certificate.passed else "the preset did not pass its protocols"
    if certificate.sim_core != solver_build(CERTIFICATION[preset].solver):
        return "the certificate is of another build of the solver"
    measured = {report.protocol for report in certificate.protocols}
    missing = [name for name in SCENE_PROTOCOLS if name not in measured]
    if missing:
        return f"the certificate lacks what a scene needs in which cloth touches cloth: {', '.join(missing)}"
    return ""


def simulate_scene(
    scene: SceneFile,
    folder: Path,
    out: Path,
    *,
    certificate: Certificate | None = None,
    allow_uncertified: bool = False,
    obj: bool = False,
    on_frame: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Run a scene and write `trajectory.npz` and `scene.json` into a new directory; return what `scene.json` says.

    Args:
        scene: What to run.
        folder: Where the files are that it names.
        out: A directory that does not exist; it appears when all is written.
        certificate: Of the preset.
        allow_uncertified: Run it without a certificate; the result records that.
        obj: Write `SHEET/0000.obj` and so on, too.
        on_frame: Called with (frames done, frames) after every frame.

    Raises:
        NotCertifiedError: No certificate vouches for it, and `allow_uncertified` is not set.
        SceneError: The scene cannot be run.
        FileExistsError: `out` exists.
    """
    why = why_uncertified(scene, certificate)
    if why and not allow_uncertified:
        raise NotCertifiedError(f"{why}; `stickslip certify --preset {scene.preset.value}` makes one")
    if out.exists():
        raise FileExistsError(f"out: must not exist, and {out} does")
    meshes = {name: _mesh(sheet) for name, sheet in scene.sheets.items()}
    run = _run(scene, folder, meshes, on_frame)
    result = {
        "scene": scene.model_dump(mode="json"),
        "digest": content_key("scene", scene.model_dump(mode="json")),
        "solver": solver_build(CERTIFICATION[scene.preset.value].solver),
        "kernel": run.kernel,
        "certified": not why,
        "certificate": None if why or certificate is None else certificate.digest,
        "why_not_certified": why,
        "valid": run.valid,
        "reason": run.reason,
        "frames": len(run.times),
        "steps": run.steps,
        "unconverged_steps": run.unconverged_steps,
        "worst_residual": run.worst_residual,
        "self_intersections": int(run.self_intersections.sum()),
        "least_distance": run.least_distance if np.isfinite(run.least_distance) else None,
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    partial_out = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        _write(partial_out, scene, meshes, run, result, obj=obj)
        partial_out.chmod(0o755)
        partial_out.rename(out)
    except BaseException:
        shutil.rmtree(partial_out, ignore_errors=True)
        raise
    return result


def _write(
    out: Path, scene: SceneFile, meshes: dict[str, Mesh], run: ClothRun, result: dict[str, Any], *, obj: bool
) -> None:
    arrays: dict[str, Any] = {
        "times": run.times,
        "contact_force": run.contact_force,
        "holder_force": run.holder_force,
        "self_intersections": run.self_intersections,
    }
    ends = np.cumsum([len(mesh.rest) for mesh in meshes.values()])[:-1]
    for name, path in zip(scene.sheets, np.split(run.positions, ends, axis=1), strict=True):
        arrays |= {
            f"{name}/positions": path,
            f"{name}/rest": meshes[name].rest,
            f"{name}/triangles": meshes[name].triangles,
        }
        if obj:
            _write_obj(out / name, meshes[name], path)
    np.savez_compressed(out / TRAJECTORY_NAME, **arrays)
    (out / RESULT_NAME).write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def _write_obj(folder: Path, mesh: Mesh, path: Array) -> None:
    folder.mkdir()
    faces = "".join(f"f {a} {b} {c}\n" for a, b, c in (mesh.triangles + 1).tolist())
    for frame, vertices in enumerate(path.tolist()):
        moved = "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices)
        (folder / f"{frame:04d}.obj").write_text(moved + faces, encoding="ascii")


def _run(
    scene: SceneFile, folder: Path, meshes: dict[str, Mesh], on_frame: Callable[[int, int], None] | None
) -> ClothRun:
    sheets = [_sheet(scene, name, meshes[name]) for name in scene.sheets]
    names = list(scene.sheets)
    rigid = [
        _rigid(body, scene.mu(names[0], name)) for name, body in scene.bodies.items() if not isinstance(body, MeshBody)
    ]
    surfaces = [
        _surface(body, f"bodies.{name}", folder, [scene.mu(sheet, name) for sheet in names])
        for name, body in scene.bodies.items()
        if isinstance(body, MeshBody)
    ]
    try:
        return custom.scene(
            sheets,
            [[scene.mu(one, other) for other in names] for one in names],
            duration=scene.duration,
            frame_rate=scene.frame_rate,
            bodies=lambda time: [at(time) for at in rigid],
            surfaces=surfaces,
            gravity=scene.gravity,
            preset=scene.preset.value,
        ).run(on_frame)
    except ValueError as error:
        raise SceneError(str(error)) from error


def _mesh(sheet: SheetOfFile) -> Mesh:
    made = sheet.mesh
    if made.type == "grid":
        return grid(*made.size, *made.cells)
    return unstructured(*made.size, made.spacing, made.seed)


def _sheet(scene: SceneFile, name: str, mesh: Mesh) -> Sheet:
    """Return a sheet where it starts, with its holders."""
    given = scene.sheets[name]
    numbers = scene.materials.get(given.material)
    start = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))]) @ rotation(given.turn).T + np.array(given.origin)
    holders: list[Holder] = []
    taken = np.zeros(len(start), dtype=bool)
    for holder, held in given.holders.items():
        place = f"sheets.{name}.holders.{holder}"
        inside = ((mesh.rest >= np.array(held.low) - 1e-9) & (mesh.rest <= np.array(held.high) + 1e-9)).all(axis=1)
        if not inside.any():
            raise SceneError(f"{place}: must hold a vertex, and none is in {list(held.low)} to {list(held.high)}")
        if (inside & taken).any():
            raise SceneError(f"{place}: must not hold what another holder holds")
        taken |= inside
        keyframes = _keyframes(held.motion or _STILL, start[inside].mean(axis=0))
        holders.append(Holder(np.flatnonzero(inside), keyframes.pose))
    return Sheet(
        mesh,
        custom_fabric(given.material, **numbers.model_dump()) if numbers else fabric(given.material),
        start,
        holders=holders,
        thickness=given.thickness,
    )


def _keyframes(motion: Motion, middle: Sequence[float] | Array) -> Keyframes:
    return Keyframes(
        [key.time for key in motion.keys],
        [key.move for key in motion.keys],
        [key.turn for key in motion.keys],
        middle if motion.about is None else motion.about,
    )


def _rigid(body: Plane | Sphere | Cylinder | Box, mu: float) -> Callable[[float], Body]:
    """Return a body that is no mesh at a time [s]."""
    if isinstance(body, Plane):
        still = plane(mu, normal=body.normal, origin=body.origin)
        return lambda _time: still

    def placed(origin: Array, turn: Array) -> Body:
        if isinstance(body, Sphere):
            return sphere(mu, body.radius, origin=origin, rotation=turn)
        if isinstance(body, Cylinder):
            return cylinder(mu, body.radius, origin=origin, rotation=turn)
        return box(mu, body.size, origin=origin, rotation=turn)

    origin, first = np.array(body.origin), rotation(body.turn)
    keyframes = _keyframes(body.motion or _STILL, origin)

    def at(time: float) -> Body:
        turn, move = keyframes.at(time)
        return placed(turn @ origin + move, turn @ first)

    return at


def _surface(body: MeshBody, place: str, folder: Path, mu: list[float]) -> Surface:
    """Return a body of triangles, from its file."""
    try:
        mesh: MovingMesh = read_moving_mesh(folder / body.file, frame_rate=body.frame_rate)
        keyframes = _keyframes(body.motion or _STILL, mesh.at(0.0).mean(axis=0))

        def at(time: float) -> Array:
            turn, move = keyframes.at(time)
            moved: Array = mesh.at(time) @ turn.T + move
            return moved

        return Surface(mesh.triangles, at, mu, body.thickness)
    except (ValueError, OSError) as error:
        raise SceneError(f"{place}: {error}") from error
