"""A scene of a user on real parts: REST, two dispatchers, a bucket, Blender, a training batch; and
what runs again.
"""

import copy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from harness import STICKSLIP, Service, read_arrays, wait_for

pytest.importorskip("obstore", reason="obstore is not installed: make setup-dev")
pytest.importorskip("moto", reason="moto is not installed: make setup-dev")

from stickslip_testing.s3 import make_bucket, s3_proxy, variables
from stickslip_training.data.samples import Samples

BLOCK = """v -0.03 -0.02 0\nv 0.03 -0.02 0\nv 0.03 0.02 0\nv -0.03 0.02 0
v -0.03 -0.02 0.02\nv 0.03 -0.02 0.02\nv 0.03 0.02 0.02\nv -0.03 0.02 {height}
f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8
"""
SCENE: dict[str, Any] = {
    "format": "stickslip-scene/1",
    "duration": 0.4,
    "frame_rate": 10,
    "preset": "fast",
    "parameters": {
        "mu": {"low": 0, "high": 2, "sets": ["friction.block.cloth"]},
        "fabric": {"sets": ["sheets.cloth.material"]},
        "pull": {
            "unit": "m",
            "low": 0,
            "high": 0.05,
            "sets": ["bodies.block.motion.keys.1.move.0"],
        },
    },
    "sheets": {
        "cloth": {
            "material": "gray-interlock",
            "mesh": {"type": "grid", "size": [0.08, 0.06], "cells": [8, 6]},
            "origin": [0, 0, 0.024],
        }
    },
    "bodies": {
        "floor": {"type": "plane"},
        "block": {
            "type": "mesh",
            "motion": {"keys": [{"time": 0}, {"time": 0.3, "move": [0.01, 0, 0]}]},
        },
    },
    "friction": [{"between": ["cloth", "block"], "mu": 0.5}],
    "default_friction": 0.4,
}


def spec(file: str, **axes: Any) -> dict[str, Any]:
    """Return a spec of the scene, whose block is an uploaded file."""
    scene = copy.deepcopy(SCENE)
    scene["bodies"]["block"]["file"] = file
    varied = {
        "mu": [0.2, 0.8],
        "fabric": ["gray-interlock", "camel-ponte-roma"],
        "pull": [0.0, 0.02],
    }
    return {
        "kind": "cloth_scene",
        "scene": scene,
        "allow_uncertified": True,
        "frames": 2,
        "quality": "preview",
        "splits": {"train": 1, "validation": 0, "test": 0},
        "axes": {**varied, "texture": "checker", "viewpoint": "front", **axes},
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
            words = [
                "dispatch",
                "--url",
                running.url,
                "--store",
                "s3://lab/one",
                "--name",
                "second",
                "--max-cpus",
                "1",
            ]
            words += ["--key-file", str(running.data / "worker-key")]
            second = subprocess.Popen([sys.executable, "-m", "stickslip_workers", *words])
            try:
                yield running
            finally:
                second.terminate()
                second.wait(timeout=60)
        finally:
            running.stop()


def upload(service: Service, height: float) -> str:
    """Upload the block, with one of its vertices at a height [m]; return its reference."""
    data = BLOCK.format(height=height).encode()
    octets = {"Content-Type": "application/octet-stream"}
    answer = httpx.post(f"{service.url}/v1/files", content=data, headers=octets, timeout=60)
    assert answer.status_code == 201, answer.text
    assert answer.json()["counts"] == [8, 12]
    return str(answer.json()["file"])


def run_job(service: Service, spec: dict[str, Any], busy: set[str]) -> dict[str, Any]:
    """Run a job to its end and return it.

    Put the names of the dispatchers that are seen at work into `busy`.
    """
    job = service.submit(spec)

    def probe() -> dict[str, Any] | None:
        busy.update(worker["name"] for worker in service.get("/v1/workers") if worker["running"])
        answer: dict[str, Any] = service.get(f"/v1/jobs/{job}")
        return answer if answer["finished_at"] is not None else None

    over = wait_for(f"the end of {job}", probe, 500)
    assert over["state"] == "succeeded", over
    return over


def ready(service: Service) -> int:
    """Return how many dispatchers can take tasks."""
    return sum(worker["condition"]["state"] == "ready" for worker in service.get("/v1/workers"))


def job_run(job: dict[str, Any]) -> dict[str, int]:
    """Return how many tasks of each stage a job has run itself."""
    stages = job["progress"]["stages"]
    return {name: sum(stage["counts"].values()) - stage["cached"] for name, stage in stages.items()}


@pytest.mark.slow
def test_from_a_users_scene_to_a_training_batch(service: Service, tmp_path: Path) -> None:
    busy: set[str] = set()
    block = upload(service, 0.02)
    job = run_job(service, spec(block), busy)
    assert job_run(job) == {"simulate": 8, "render": 8, "pack": 1, "publish": 1}
    pulled = tmp_path / "pulled"
    version = job["dataset"]["dataset"]
    subprocess.run(
        [STICKSLIP, "pull", version, pulled, "--url", service.url], check=True, capture_output=True
    )
    subprocess.run([STICKSLIP, "verify", pulled], check=True, capture_output=True)
    arrays = read_arrays(pulled)
    assert arrays["valid"].all()
    assert arrays["cloth.positions"].shape == (8, 5, 63, 3)
    assert sorted(set(arrays["mu"])) == [0.2, 0.8]
    assert set(arrays["cloth.contact"][:, -1].ravel()) > {0}
    pose, pull = arrays["body_pose"][:, -1, 0, 0, 3], arrays["pull"]
    assert pose == pytest.approx(pull, abs=1e-6)
    (batch,) = Samples(pulled, "train").loader(8)
    assert batch["video"].shape == (8, 2, 224, 224, 3)
    assert set(batch.names("fabric")) == {"gray-interlock", "camel-ponte-roma"}

    # The same file and the same spec again: nothing runs, and the same dataset answers.
    assert upload(service, 0.02) == block
    again = run_job(service, spec(block), busy)
    assert set(job_run(again).values()) == {0}
    assert again["dataset"] == job["dataset"]
    # One more friction: only its samples run.
    more = spec(block, mu=[0.2, 0.8, 1.0])
    known = httpx.post(f"{service.url}/v1/jobs:validate", json=more, timeout=60).json()
    assert known["cached_count"] == 16  # simulations and renders of two frictions
    # One vertex of the block elsewhere: all runs, on both nodes together.
    wait_for("both nodes", lambda: ready(service) == 2 or None, 60)
    moved = run_job(service, spec(upload(service, 0.0195)), busy)
    assert job_run(moved) == job_run(job)
    assert moved["dataset"]["dataset"] != version
    assert len(busy) == 2
    assert "second" in busy
