"""The page of a sample of a scene: shapes of its sheets, curves with the names of its things."""

from types import SimpleNamespace

import numpy as np
from stickslip_schemas.format.layout import layout
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_services.pages.browsing import sample_view


def test_a_scene_shows_its_sheets_and_the_forces_between_its_things() -> None:
    spec = job_spec_adapter.validate_python(
        {
            "kind": "cloth_scene",
            "scene": "on-cloth",
            "set": {"sheets.cloth.mesh.cells": [4, 4], "sheets.stretched.mesh.cells": [4, 4]},
            "allow_uncertified": True,
            "axes": {"texture": "checker", "viewpoint": "front"},
        }
    )
    arrays = {array.name: array for array in layout(spec)}
    values = {name: np.zeros(array.shape, dtype=array.dtype) for name, array in arrays.items()}
    data = SimpleNamespace(
        arrays=arrays,
        manifest=SimpleNamespace(spec=spec),
        read=lambda name, _slot: values[name],
        named=lambda _array, value: value.tolist(),
    )
    shown = sample_view(data, 0)  # type: ignore[arg-type]
    assert [shape["name"] for shape in shown["shapes"]] == ["cloth.positions", "stretched.positions"]
    assert [picture["name"] for picture in shown["pictures"]] == ["video"]

    text = " ".join(shown["plots"])
    for name in ("cloth, floor", "cloth, stretched", "cloth.left", "stretched.frame"):
        assert name in text
    assert next(iter(shown["labels"])) == "fabric"
