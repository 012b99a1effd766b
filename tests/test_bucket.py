"""A dataset that is made in a bucket: real coordinator, dispatcher, Ray and Blender, and a real S3
server.
"""

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import STICKSLIP, Service, read_arrays
from stickslip_sim_core import solve_rods
from zarr.storage import ObjectStore

pytest.importorskip("obstore", reason="obstore is not installed: make setup-dev")
pytest.importorskip("moto", reason="moto is not installed: make setup-dev")

import obstore.store
from stickslip_testing.s3 import make_bucket, s3_proxy, variables

SPEC: dict[str, Any] = {
    "kind": "rod_hang",
    "axes": {"gamma": [100, 700], "phi0": 1, "phi1": [8, 12, 15]},
    "quality": "draft",
    "samples_per_shard": 4,
}


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Service]:
    with s3_proxy() as proxy:
        for name, value in variables(proxy).items():
            monkeypatch.setenv(name, value)
        make_bucket(proxy, "lab")
        running = Service(tmp_path / "data", "--store", "s3://lab/one")
        try:
            running.start()
            yield running
        finally:
            running.stop()


@pytest.mark.slow
def test_a_dataset_is_made_read_and_collected_in_a_bucket(service: Service, tmp_path: Path) -> None:
    over = service.finished(service.submit(SPEC))
    assert over["state"] == "succeeded", over["message"]
    dataset = over["dataset"]["dataset"]
    served = read_arrays(f"{service.url}/v1/datasets/{dataset}/versions/1/files/")
    pulled = tmp_path / "pulled"
    subprocess.run(
        [STICKSLIP, "pull", dataset, pulled, "--url", service.url], check=True, capture_output=True
    )
    service.stop()  # the bucket is read without anything of ours
    version = obstore.store.S3Store("lab", prefix=f"one/datasets/{dataset}/v1")
    stored, local = read_arrays(ObjectStore(version, read_only=True)), read_arrays(pulled)
    assert stored.keys() == served.keys() == local.keys() >= {"views", "centerline", "sample_key"}
    for name, values in stored.items():
        assert np.array_equal(values, served[name], equal_nan=values.dtype.kind == "f")
        assert np.array_equal(values, local[name], equal_nan=values.dtype.kind == "f")
    solution = solve_rods(stored["gamma"], stored["phi0"], stored["phi1"])
    assert np.array_equal(stored["centerline"], solution.centerline.astype(np.float32))
    assert stored["views"].reshape(6, -1).max(axis=1).all()

    place = ["--data", str(service.data), "--store", "s3://lab/one"]
    collected = subprocess.run(
        [STICKSLIP, "gc", "--older-than", "0", *place], capture_output=True, text=True, check=True
    )
    assert (
        collected.stdout == "0 files, 0.0 MB, that nothing refers to may be deleted: add --delete\n"
    )
    assert not (service.data / "store").exists()
