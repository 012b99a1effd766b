"""What `stickslip fit` takes from a file of observations, and what it refuses."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.store import open_store
from stickslip_sim_core.observations import PIXEL_NOISE, Silhouettes, Vertices
from stickslip_workers import fitting

SCENE: dict[str, Any] = {
    "format": "stickslip-scene/1",
    "duration": 0.2,
    "frame_rate": 10,
    "preset": "fast",
    "parameters": {"mu": {"low": 0, "high": 1, "sets": ["friction.cloth.floor"]}},
    "sheets": {
        "cloth": {
            "material": "gray-interlock",
            "mesh": {"type": "grid", "size": [0.1, 0.1], "cells": [4, 4]},
            "start": {"type": "hung", "bias_until": 0},
            "origin": [0, 0, 0.06],
            "turn": [1.5707963267948966, 0, 0],
            "holders": {"top": {"edge": "top"}},
        }
    },
    "bodies": {"floor": {"type": "plane"}},
    "friction": [{"between": ["cloth", "floor"], "mu": 0.3}],
    "default_friction": 0.5,
}

REQUEST = {"parameters": ["mu"], "start": {}, "multistart": 1, "seed": 0}


def picture() -> dict[str, Any]:
    """Return two pictures of 6 x 8 pixels with a square of cloth."""
    masks = np.zeros((2, 6, 8), bool)
    masks[:, 2:4, 3:5] = True
    return {"frames": np.array([1, 2]), "top.masks": masks, "top.matrix": np.eye(3, 4)}


class _BegunError(Exception):
    """Ends a fit before it runs."""


def observations_of_the_fit(
    observed: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> list[Any]:
    observations: list[Any] = []

    def recorded(_scenes: Any, of_file: list[Any], *_: Any, **__: Any) -> Any:
        observations.extend(of_file)
        raise _BegunError

    monkeypatch.setattr(fitting, "fit", recorded)
    with pytest.raises(_BegunError):
        fitted(observed, tmp_path)
    return observations


def fitted(observed: dict[str, Any], tmp_path: Path) -> Any:
    scene = Scene.model_validate(SCENE)
    return fitting.fit_scene(scene, observed, REQUEST, open_store(str(tmp_path)))


def test_masks_of_cameras_and_vertices_of_sheets_are_fitted_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    side = {"side.masks": picture()["top.masks"], "side.matrix": np.eye(3, 4)}
    vertices = {"cloth.positions": np.zeros((2, 25, 3)), "noise": np.array(1e-3)}
    observations = observations_of_the_fit(picture() | side | vertices, tmp_path, monkeypatch)
    assert [type(observation) for observation in observations] == [
        Vertices,
        Silhouettes,
        Silhouettes,
    ]
    assert [observation.noise for observation in observations] == [1e-3, PIXEL_NOISE, PIXEL_NOISE]
    # A square of 2 x 2 pixels has eight neighbours in rows and columns, in two pictures.
    assert observations[1].count == observations[2].count == 2 * 8


def test_hidden_pixels_and_noise_of_pictures_are_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hidden = np.zeros((2, 6, 8), bool)
    hidden[:, 1] = True
    more = {"top.hidden": hidden, "pixel_noise": np.array(0.6)}
    (silhouettes,) = observations_of_the_fit(picture() | more, tmp_path, monkeypatch)
    assert silhouettes.noise == 0.6
    assert silhouettes.count == 2 * (8 - 2)


@pytest.mark.parametrize(
    ("without", "more", "message"),
    [
        ("frames", {}, "frames: must be in the file of observations"),
        ("top.masks", {}, r"cloth\.positions or CAMERA\.masks: must be in the file"),
        ("top.matrix", {}, r"top\.matrix: must be in the file of observations"),
        ("", {"top.masks": np.zeros((2, 6, 8), bool)}, r"top\.masks: must show an outline"),
        ("", {"top.masks": np.zeros((2, 6, 8))}, r"top\.masks: must be booleans"),
        ("", {"top.matrix": np.eye(3)}, r"top\.matrix: must have the shape \(3, 4\)"),
        ("", {"pixel_noise": np.array(-1.0)}, "pixel_noise: must be"),
        ("", {"cloth.positions": np.zeros((2, 25, 3))}, "noise: must be in the file"),
    ],
)
def test_wrong_files_are_refused(
    without: str, more: dict[str, Any], message: str, tmp_path: Path
) -> None:
    observed = {name: array for name, array in picture().items() if name != without}
    with pytest.raises(ValueError, match=message):
        fitted(observed | more, tmp_path)
