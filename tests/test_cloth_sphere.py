"""The third kind on real parts: from its spec to a training batch, with nothing but its own files."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import Service, read_arrays
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.grid import dataset_id
from stickslip_training.data.samples import Samples

SPEC: dict[str, Any] = {
    "kind": "cloth_sphere",
    "allow_uncertified": True,
    "axes": {
        "material": "gray-interlock",
        "mu": 0.5,
        "angular_speed": 2.0,
        "texture": ["checker", "dots"],
        "viewpoint": "front",
        "bending": 2.0,
    },
    "preset": "fast",
    "mesh": 9,
    "frames": 3,
    "quality": "draft",
    "splits": {"train": 1, "validation": 0, "test": 0},
}


def test_from_spec_to_training_batch(service: Service) -> None:
    job = service.finished(service.submit(SPEC))
    assert job["state"] == "succeeded"
    directory = service.data / "store" / "datasets" / dataset_id(job_spec_adapter.validate_python(SPEC)) / "v1"
    arrays = read_arrays(directory)
    assert arrays["valid"].all()
    assert arrays["angle"][0, -1] == np.float32(2.0 * (149 / 15 - 3.0))
    assert arrays["bending"].tolist() == [2.0, 2.0]
    rested, turned = (np.unwrap(np.arctan2(*arrays["positions"][0, i, :, 1::-1].T)) for i in (30, -1))
    assert np.median(turned - rested) > 0.5  # friction has dragged the cloth along
    (batch,) = Samples(directory, "train").loader(2)
    assert batch["video"].shape == (2, 3, 224, 224, 3)
    assert torch.equal(batch["angular_speed"], torch.tensor([2.0, 2.0]))
    assert batch.names("texture") == ["checker", "dots"]


def test_its_clips_show_a_cloth_on_a_ball(service: Service, tmp_path: Path) -> None:
    job = service.finished(service.submit(SPEC))
    arrays = read_arrays(service.data / "store" / "datasets" / job["dataset"]["dataset"] / "v1")
    clip = arrays["video"][0].astype(float)
    assert clip[0, 70:150, 70:150].std() > 20.0  # a pattern in the middle of the picture
    assert np.abs(clip[2] - clip[1]).mean() > 1.0  # that moves
