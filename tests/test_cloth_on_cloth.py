"""Cloth that is dragged over cloth, on real parts: from its spec to a training batch."""

from typing import Any

import numpy as np
from harness import Service, read_arrays
from stickslip_training.data.samples import Samples

SPEC: dict[str, Any] = {
    "kind": "cloth_on_cloth",
    "allow_uncertified": True,
    "axes": {
        "material": "gray-interlock",
        "substrate_material": "my-felt",
        "mu": 0.5,
        "texture": ["checker", "dots"],
        "viewpoint": "calibrated",
    },
    "materials": {"my-felt": {"density": 0.3, "young": 1e6, "poisson": 0.3, "thickness": 1e-3}},
    "preset": "fast",
    "mesh": 9,
    "frames": 3,
    "quality": "draft",
    "splits": {"train": 1, "validation": 0, "test": 0},
}


def test_from_spec_to_training_batch(service: Service) -> None:
    job = service.finished(service.submit(SPEC))
    assert job["state"] == "succeeded"
    directory = service.data / "store" / "datasets" / job["dataset"]["dataset"] / "v1"
    arrays = read_arrays(directory)
    assert arrays["valid"].all()
    assert 4e-4 < arrays["least_distance"].min() <= 5e-4  # it lies on the other, half a millimetre apart
    # The stretched cloth carries what the holders do not, and holds it back by mu times that in the steady drag.
    holders, below = arrays["holder_force"][0], arrays["contact_force"][0]
    steady = slice(60, 85)
    assert np.allclose(holders[steady, 2] + below[steady, 2], holders[0, 2], rtol=1e-3)
    assert np.allclose(np.abs(below[steady, 0]), 0.5 * below[steady, 2], rtol=2e-3)
    (batch,) = Samples(directory, "train").loader(2)
    assert batch["video"].shape == (2, 3, 224, 224, 3)
    assert batch.names("substrate_material") == ["my-felt", "my-felt"]
