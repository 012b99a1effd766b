"""What can never work is refused before anything is queued, with path, rule, value and remedy."""

import json
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from stickslip_services.app import make_app
from stickslip_services.cli import app
from stickslip_services.settings import Settings
from stickslip_testing.servers import serving

SCENE: dict[str, Any] = {
    "format": "stickslip-scene/1",
    "duration": 0.1,
    "preset": "fast",
    "sheets": {
        "cloth": {
            "material": "gray-interlock",
            "mesh": {"type": "grid", "size": [0.1, 0.1], "cells": [4, 4]},
            "origin": [0.0, 0.0, 0.06],
        },
    },
    "bodies": {"floor": {"type": "plane"}},
    "default_friction": 0.4,
    "parameters": {
        "height": {"unit": "m", "low": -0.1, "high": 0.1, "sets": ["sheets.cloth.origin.2"]}
    },
}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    application = make_app(Settings(data=tmp_path_factory.mktemp("start"), durable=False))
    with serving(application) as url, httpx.Client(base_url=url, timeout=60) as client:
        yield client


def spec(scene: dict[str, Any], **axes: Any) -> dict[str, Any]:
    return {
        "kind": "cloth_scene",
        "name": "start",
        "scene": scene,
        "frames": 2,
        "allow_uncertified": True,
        "axes": {"texture": "checker", "viewpoint": "front", **axes},
    }


def two_sheets(distance: float) -> dict[str, Any]:
    document = deepcopy(SCENE)
    document["sheets"]["other"] = deepcopy(document["sheets"]["cloth"])
    document["sheets"]["other"]["origin"] = [0.0, 0.0, 0.06 + distance]
    return document


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/jobs:validate"])
def test_two_sheets_at_no_distance(client: httpx.Client, path: str) -> None:
    answer = client.post(path, json=spec(two_sheets(0.0)))
    assert answer.status_code == 422
    (error,) = answer.json()["errors"]
    assert error["pointer"] == "/scene/sheets/other/origin"
    assert "must not lie in sheet cloth at the start, and vertex 0" in error["rule"]
    assert "leave half of both thicknesses between them" in error["rule"]
    assert json.loads(error["value"]) == [0.0, 0.0, 0.06]
    assert client.get("/v1/jobs").json()["items"] == []


def test_two_sheets_apart(client: httpx.Client) -> None:
    assert client.post("/v1/jobs:validate", json=spec(two_sheets(0.001))).status_code == 200


@pytest.mark.parametrize(
    ("heights", "status"), [([-0.02, -0.01], 422), ([-0.02, 0.01], 200), ([0.01], 200), (None, 200)]
)
def test_one_sample_that_can_start_is_enough(
    client: httpx.Client, heights: list[float] | None, status: int
) -> None:
    """Samples that cannot are rejected one by one, as a result."""
    axes = {} if heights is None else {"height": heights}
    answer = client.post("/v1/jobs:validate", json=spec(SCENE, **axes))
    assert answer.status_code == status
    if status == 422:
        (error,) = answer.json()["errors"]
        assert "vertex 0 of the sheet is 20 mm inside floor" in error["rule"]


def test_a_triangle_soup(client: httpx.Client, tmp_path: Path) -> None:
    flat = np.array([[0, 0], [0.1, 0], [0.1, 0.1], [0, 0], [0.1, 0.1], [0, 0.1]])
    flat[3:] += 1e-3  # vertices at other positions, which no welding joins
    lines = [f"v {x} {y} 0\nvt {x} {y}" for x, y in flat]
    data = "\n".join([*lines, "f 1/1 2/2 3/3", "f 4/4 5/5 6/6"])
    upload = client.post("/v1/files", content=data.encode())
    assert upload.status_code == 201, upload.text
    document = deepcopy(SCENE)
    mesh = {"type": "file", "file": upload.json()["file"], "counts": upload.json()["counts"]}
    document["sheets"]["cloth"]["mesh"] = mesh
    answer = client.post("/v1/jobs", json=spec(document))
    assert answer.status_code == 422
    (error,) = answer.json()["errors"]
    assert error["pointer"] == "/scene/sheets/cloth/mesh/file"
    assert "1 piece: weld vertices at equal positions" in error["rule"]
    assert error["value"] == "2"
    document["sheets"]["cloth"]["mesh"]["file"] = "soup.obj"
    del document["sheets"]["cloth"]["mesh"]["counts"]
    (tmp_path / "soup.obj").write_text(data)
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(document))
    result = CliRunner().invoke(app, ["scene", "check", str(tmp_path / "scene.yaml")])
    assert result.exit_code == 1
    assert "scene.yaml can never work\n  sheets.cloth.mesh.file: must have" in result.output
    assert result.output.rstrip().endswith("and it is 2")


def test_scene_check_of_a_built_in_scene() -> None:
    result = CliRunner().invoke(app, ["scene", "check", "on-cloth"])
    assert result.exit_code == 0, result.output
