"""A simulation that is asked for derivatives records all arrays and labels of its dataset."""

from typing import Any

import pytest
from stickslip_schemas.documents.tasks import SimulateOutput, SimulateTask
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.store import DirectoryStore
from stickslip_workers.stages.run import Records, run_tasks

pytestmark = pytest.mark.physics

DRAG: dict[str, Any] = {
    "kind": "cloth_drag",
    "mesh": 5,
    "preset": "fast",
    "self_friction": None,
    "axes": {
        "material": "gray-interlock",
        "mu": 0.3,
        "texture": "checker",
        "viewpoint": "calibrated",
    },
}

SCENE: dict[str, Any] = {
    "kind": "cloth_scene",
    "frames": 2,
    "scene": {
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
    },
    "axes": {"texture": "checker", "viewpoint": "front"},
}


@pytest.mark.parametrize("document", [DRAG, SCENE])
def test_the_record_has_all_arrays(document: dict[str, Any], store: DirectoryStore) -> None:
    spec: JobSpec = job_spec_adapter.validate_python({**document, "sensitivities": ["mu"]})
    simulation = spec.simulation(next(iter(spec.grid())))
    (result,) = run_tasks([SimulateTask(simulation=simulation)], store)
    assert isinstance(result.output, SimulateOutput), result.message
    record = Records(store)(result.output.record.digest)
    for array in spec.arrays():
        if array.is_recorded:
            assert record[array.name].shape[1:] == array.shape
            assert record[array.name].dtype == array.dtype
        elif "_by_" in array.name or array.name in ("unrefined_steps", "refinement_change"):
            assert array.name in result.output.labels
