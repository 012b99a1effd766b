"""Fits of a scene's parameters to observed vertices, for `stickslip fit`."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.kinds.cloth.sensitivities import differentiated, why_not_differentiable
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.files import with_arrays
from stickslip_schemas.store import Store
from stickslip_sim_core.fit import Fit, fit
from stickslip_sim_core.observations import Vertices
from stickslip_sim_core.scenes import cloth_scene
from stickslip_sim_core.scenes.cloth_scene import FamilyParameter
from stickslip_sim_core.scenes.family import SceneFamily

Arrays = Mapping[str, npt.NDArray[Any]]


def fit_scene(
    scene: Scene, observed: Arrays, request: Mapping[str, Any], store: Store
) -> dict[str, Any]:
    """Fit parameters of a scene to observed vertices, and return the answer as JSON.

    Args:
        scene: The scene.
        observed: `frames` (T,), `noise` [m], and of a sheet `SHEET.positions` (T, K, 3) [m] and,
            unless all its vertices were seen, `SHEET.vertices` (K,).
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


def _observations(scene: Scene, observed: Arrays) -> list[Vertices]:
    for name in ("frames", "noise"):
        if name not in observed:
            raise ValueError(f"{name}: must be in the file of observations")
    observations = []
    begin = 0
    for name, sheet in scene.sheets.items():
        count = sheet.mesh.shape[0]
        positions = observed.get(f"{name}.positions")
        vertices = np.asarray(observed.get(f"{name}.vertices", np.arange(count)), np.intp)
        if positions is not None:
            if not ((vertices >= 0) & (vertices < count)).all():
                raise ValueError(f"{name}.vertices: must be within 0 ... {count - 1}")
            frames = np.asarray(observed["frames"], np.intp).tolist()
            noise = float(observed["noise"])
            observations.append(
                Vertices(frames, np.asarray(positions, float), begin + vertices, noise)
            )
        begin += count
    if not observations:
        names = " or ".join(f"{name}.positions" for name in scene.sheets)
        raise ValueError(f"{names}: must be in the file of observations")
    return observations


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
