"""A shawl over the shoulders of a figure, on real parts: from its spec to a training batch."""

from typing import Any

import numpy as np
import pytest
from harness import Service, read_arrays
from stickslip_sim_core.scenes.character import bones, figure
from stickslip_training.data.samples import Samples

SPEC: dict[str, Any] = {
    "kind": "shawl",
    "allow_uncertified": True,
    "axes": {
        "material": "felt",
        "mu": 0.9,
        "self_friction": 0.4,
        "swing": 0.3,
        "texture": ["checker", "dots"],
        "viewpoint": "front",
    },
    "materials": {"felt": {"density": 0.3, "young": 1e6, "poisson": 0.3, "thickness": 1e-3}},
    "preset": "fast",
    "mesh": 19,
    "frames": 3,
    "quality": "draft",
    "ground_truth": ["segmentation"],
    "splits": {"train": 1, "validation": 0, "test": 0},
}


@pytest.mark.slow
def test_from_spec_to_training_batch(service: Service) -> None:
    job = service.finished(service.submit(SPEC), timeout=900.0)
    assert job["state"] == "succeeded"
    directory = service.data / "store" / "datasets" / job["dataset"]["dataset"] / "v1"
    arrays = read_arrays(directory)
    assert arrays["valid"].all()
    assert arrays["self_friction"].tolist() == [0.4, 0.4]
    assert arrays["swing"].tolist() == [0.3, 0.3]
    assert not arrays["self_intersections"].any()
    # The figure in the dataset is the one that the cloth lay on, and it moved.
    assert np.allclose(arrays["skin_rest"][0], figure().rest, atol=1e-6)
    assert np.allclose(arrays["skin_weights"][0], figure().weights, atol=1e-6)
    assert np.array_equal(arrays["skin_triangles"][0], figure().triangles)
    assert np.allclose(arrays["bones"][0, 120], bones(8.0, swing=0.3), atol=1e-6)
    assert np.abs(arrays["bones"][0, 120] - arrays["bones"][0, 0]).max() > 0.01
    # It still hangs on the shoulders, and the figure carries it.
    assert arrays["positions"][0, -1, :, 2].max() > 0.4
    a, b, c = np.moveaxis(arrays["rest"][0].astype(float)[arrays["triangles"][0]], 1, 0)
    area = 0.5 * np.linalg.det(np.stack([b - a, c - a], axis=1)).sum()
    weight = arrays["areal_density"][0] * area * 9.81
    assert np.median(arrays["contact_force"][0, 60:, 2]) == pytest.approx(weight, rel=0.1)
    # Pictures show floor, cloth and figure.
    assert set(np.unique(arrays["segmentation"][0])) >= {1, 2, 3}
    clip = arrays["video"][0].astype(float)
    assert np.abs(clip[2] - clip[1]).mean() > 0.3
    (batch,) = Samples(directory, "train").loader(2)
    assert batch["video"].shape == (2, 3, 224, 224, 3)
    assert np.allclose(batch["self_friction"], 0.4)
    assert batch.names("viewpoint") == ["front", "front"]
