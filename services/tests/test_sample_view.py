"""The page of a sample of a scene: shapes of its sheets, curves with the names of its things."""

from types import SimpleNamespace

import numpy as np
from stickslip_schemas.format.layout import layout
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.spec.arrays import array
from stickslip_services.pages.browsing import coloured, sample_view


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
    assert (shown["layers"], len(shown["frames"])) == (["video"], arrays["video"].shape[0])
    assert shown["instants"] == arrays["cloth.positions"].shape[0]

    text = " ".join(shown["plots"])
    for name in ("cloth, floor", "cloth, stretched", "cloth.left", "stretched.frame"):
        assert name in text
    assert text.count('class="cursor"') == len(shown["plots"])
    assert list(shown["groups"]) == ["Parameters", "Looks", "Physics", "Checks"]
    assert next(iter(shown["groups"]["Parameters"])) == "fabric"
    assert {"psnr_cloth", "light"} <= set(shown["groups"]["Looks"])
    assert {"stretch", "valid"} <= set(shown["groups"]["Checks"])


def test_ground_truth_is_shown_in_colours() -> None:
    y_x = {"frame": 2, "y": 1, "x": 2}
    flow = np.array([[[[0.0, 2.0], [-1.0, 0.0]]]] * 2, dtype=np.float16)
    assert coloured(array("flow", "", "float16", y_x | {"xy": 2}), flow, 1).tolist() == [
        [[127, 255, 127], [63, 127, 127]]
    ]
    depth = np.array([[[1.0, np.inf]], [[3.0, 2.0]]], dtype=np.float32)
    assert coloured(array("depth", "", "float32", y_x), depth, 0).tolist() == [[[0, 0, 0], [0, 0, 0]]]
    assert coloured(array("depth", "", "float32", y_x), depth, 1).tolist() == [[[255] * 3, [127] * 3]]
    codes = array("segmentation", "", "uint8", y_x, attributes={"categories": ["background", "cloth"]})
    assert len(np.unique(coloured(codes, np.array([[[0, 1]]] * 2, dtype=np.uint8), 0), axis=1)[0]) == 2
