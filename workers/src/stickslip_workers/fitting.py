"""Fits of a scene's parameters to vertices or pictures that were seen, for `stickslip fit`."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.kinds.cloth.sensitivities import differentiated, why_not_differentiable
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.files import with_arrays
from stickslip_schemas.store import Store
from stickslip_sim_core.arrays import check_positive
from stickslip_sim_core.fit import Fit, Observation, fit
from stickslip_sim_core.observations import PIXEL_NOISE, Silhouettes, Vertices, View
from stickslip_sim_core.scenes import cloth_scene
from stickslip_sim_core.scenes.cloth_scene import FamilyParameter
from stickslip_sim_core.scenes.family import SceneFamily

Arrays = Mapping[str, npt.NDArray[Any]]


def fit_scene(
    scene: Scene, observed: Arrays, request: Mapping[str, Any], store: Store
) -> dict[str, Any]:
    """Fit parameters of a scene to observations of it, and return the answer as JSON.

    Args:
        scene: The scene.
        observed: `frames` (T,). Of a sheet `SHEET.positions` (T, K, 3) [m] with `noise` [m] and,
            unless all its vertices were seen, `SHEET.vertices` (K,). Of a camera `CAMERA.masks`
            (T, height, width), where any sheet is seen, and `CAMERA.matrix` (3, 4), with
            `CAMERA.hidden`, where something may hide cloth, and `pixel_noise` if they are there.
        request: `parameters`, `start`, `multistart` and `seed`, as `fit` takes them.
        store: Files that the scene names.

    Raises:
        ValueError: A value breaks its rule; the message begins with its place.
    """
    scenes = _family(scene, with_arrays(scene, store.read), request["parameters"])
    answer = fit(
        scenes,
        _observations(scene, observed),
        request["parameters"],
        start=request["start"],
        multistart=request["multistart"],
        seed=request["seed"],
    )
    return _as_json(scene, answer)


def _family(scene: Scene, document: Mapping[str, Any], names: list[str]) -> SceneFamily:
    parameters = {}
    for name in names:
        if name not in scene.parameters:
            known = ", ".join(scene.parameters) or "none"
            raise ValueError(f"parameters: must be of {known}, which the scene has, got {name!r}")
        reason = why_not_differentiable(scene, name)
        if reason:
            raise ValueError(f"parameters: {name} {reason}, so it cannot be fitted")
        described = differentiated(scene, name)
        parameters[name] = FamilyParameter(**described.model_dump())
    return cloth_scene.family(document, parameters)


def _observations(scene: Scene, observed: Arrays) -> list[Observation]:
    if "frames" not in observed:
        raise ValueError("frames: must be in the file of observations")
    frames = np.asarray(observed["frames"], np.intp).tolist()
    observations: list[Observation] = [
        *_vertices(scene, observed, frames),
        *_silhouettes(observed, frames),
    ]
    if not observations:
        names = " or ".join(f"{name}.positions" for name in scene.sheets)
        raise ValueError(f"{names} or CAMERA.masks: must be in the file of observations")
    return observations


def _vertices(scene: Scene, observed: Arrays, frames: list[int]) -> Iterator[Vertices]:
    begin = 0
    for name, sheet in scene.sheets.items():
        count = sheet.mesh.shape[0]
        positions = observed.get(f"{name}.positions")
        vertices = np.asarray(observed.get(f"{name}.vertices", np.arange(count)), np.intp)
        if positions is not None:
            if "noise" not in observed:
                raise ValueError("noise: must be in the file of observations, beside positions")
            if not ((vertices >= 0) & (vertices < count)).all():
                raise ValueError(f"{name}.vertices: must be within 0 ... {count - 1}")
            noise = float(observed["noise"])
            yield Vertices(frames, np.asarray(positions, float), begin + vertices, noise)
        begin += count


def _silhouettes(observed: Arrays, frames: list[int]) -> Iterator[Silhouettes]:
    noise = float(observed.get("pixel_noise", PIXEL_NOISE))
    check_positive(pixel_noise=noise)
    for key in observed:
        camera, _, kind = key.rpartition(".")
        if kind != "masks":
            continue
        if f"{camera}.matrix" not in observed:
            raise ValueError(f"{camera}.matrix: must be in the file of observations, beside {key}")
        hidden = observed.get(f"{camera}.hidden")
        try:
            yield Silhouettes.of_masks(
                frames,
                observed[key],
                View(np.asarray(observed[f"{camera}.matrix"], float)),
                hidden=hidden,
                noise=noise,
            )
        except ValueError as error:
            raise ValueError(f"{camera}.{error}") from error


def _as_json(scene: Scene, answer: Fit) -> dict[str, Any]:
    return {
        "values": dict(answer.values),
        "deviations": dict(answer.deviations),
        "by_noise": dict(answer.by_noise),
        # JSON has no NaN.
        "by_steps": {
            name: shift if np.isfinite(shift) else None for name, shift in answer.by_steps.items()
        },
        "units": {name: scene.parameters[name].unit for name in answer.values},
        "mean_square": answer.mean_square,
        "is_explained": answer.is_explained,
        "minima": answer.minima,
        "runs": answer.runs,
        "warning": answer.warning,
        "searches": [search._asdict() for search in answer.searches],
    }
