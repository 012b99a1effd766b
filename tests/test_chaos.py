"""Kill -9 anything in the middle of the demo's rods job and start again: every sample once, every hash right."""

import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import yaml
from harness import Service, command_line, descendants, read_arrays, wait_for
from stickslip_schemas.builds import Builds
from stickslip_schemas.keys import sha256
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.manifest import SEAL_NAME, SEALED_NAMES, Manifest
from stickslip_schemas.samples import samples
from stickslip_schemas.store import Store
from stickslip_services.database.database import Database
from stickslip_services.queue.audit import audit
from stickslip_sim_core import solve_rods

SPEC: dict[str, Any] = yaml.safe_load((Path(__file__).parents[1] / "examples" / "demo-rods.yaml").read_text())


@pytest.fixture
def service(tmp_path: Path) -> Any:
    running = Service(tmp_path / "data")
    running.start()
    yield running
    running.stop()


def test_a_job_survives_the_death_of_every_process(service: Service) -> None:
    job = service.submit(SPEC)

    wait_for_renders(service, job, 4)
    kill(service.child("stickslip_services.coordinator"))
    wait_for_renders(service, job, 10)
    kill(service.child("stickslip_workers"))
    wait_for_renders(service, job, 16)
    kill(render_process(service))
    wait_for_renders(service, job, 22)
    service.kill()
    wait_for("the end of all processes", lambda: True if not service.all_processes() else None, 30)
    service.start()
    over = service.finished(job)
    assert over["state"] == "succeeded", over["message"]

    again = service.finished(service.submit(SPEC))
    assert again["dataset"] == over["dataset"]
    version = service.get(f"/v1/datasets/{over['dataset']['dataset']}")["versions"]
    assert [item["version"] for item in version] == [1]
    builds = Builds.model_validate(service.get("/v1/workers")[0]["builds"]["rod_hang"])
    service.stop()
    assert service.all_processes() == []
    check_ledger(service.data)
    check_dataset(service.data, over["dataset"], builds)


def renders_done(service: Service, job: str) -> int:
    counts: dict[str, int] = service.get(f"/v1/jobs/{job}")["progress"]["stages"]["render"]["counts"]
    return counts.get("succeeded", 0)


def wait_for_renders(service: Service, job: str, count: int) -> None:
    """Wait until `count` renders are done; the job must not be over then, or the next kill would prove nothing."""

    def probe() -> int | None:
        try:
            done = renders_done(service, job)
        except (httpx.TransportError, KeyError):  # the coordinator is away, or the job is not planned yet
            return None
        return done if done >= count else None

    assert wait_for(f"{count} renders", probe, 120) < 48


def render_process(service: Service) -> int:
    """Return a process that has Blender in it and is at work."""

    def probe() -> int | None:
        for pid in descendants(service.child("stickslip_workers")):
            try:
                if "/bpy/" in Path(f"/proc/{pid}/maps").read_text():
                    return pid
            except OSError:
                continue
        return None

    return wait_for("a render process", probe, 30)


def kill(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)


def check_ledger(data: Path) -> None:
    database = Database(data / "coordinator.sqlite3")
    with database.read() as connection:
        assert audit(connection) == []
    database.close()


def check_dataset(data: Path, reference: dict[str, Any], builds: Builds) -> None:
    """Every slot holds its own sample, and every byte is what the manifest says."""
    store = Store(data / "store")
    directory = store.dataset_path(reference["dataset"], reference["version"])
    text = (directory / "manifest.json").read_bytes()
    assert sha256(text) == reference["manifest"]
    manifest = Manifest.model_validate_json(text)
    assert manifest.sample_keys == tuple(
        sample.key for sample in samples(job_spec_adapter.validate_python(SPEC), builds)
    )
    assert len(set(manifest.sample_keys)) == 48
    assert manifest.valid_count == 48
    files = {str(path.relative_to(directory)) for path in directory.rglob("*") if path.is_file()}
    assert files == {file.path for file in manifest.files} | set(SEALED_NAMES) | {SEAL_NAME}
    for file in manifest.files:
        assert sha256((directory / file.path).read_bytes()) == file.sha256
    group = read_arrays(directory)
    solution = solve_rods(group["gamma"], group["phi0"], group["phi1"])
    assert np.array_equal(group["centerline"], solution.centerline.astype(np.float32))
    pictures = {views.tobytes() for views in group["views"]}
    assert len(pictures) == 48


RAY = ("raylet/raylet", "gcs/gcs_server")


def test_ray_listens_on_loopback_and_is_replaced_at_once_when_it_dies(service: Service) -> None:
    def session() -> str | None:
        alive = [worker["id"] for worker in service.get("/v1/workers") if worker["alive"]]
        return alive[0] if alive else None

    assert service.process is not None
    before = wait_for("a worker", session, 60)
    ours = {service.process.pid, *descendants(service.process.pid)}
    listeners = subprocess.run(["ss", "-ltnpH"], capture_output=True, text=True, check=True).stdout.splitlines()
    places = [line.split()[3] for line in listeners if any(f"pid={pid}," in line for pid in ours)]
    assert len(places) >= 3  # the coordinator's and Ray's
    assert all("127.0.0.1]:" in place or place.startswith("127.0.0.1:") for place in places), places
    for part in RAY:
        kill(next(pid for pid in descendants(service.process.pid) if part in command_line(pid)))

        def replaced(old: str = before) -> str | None:
            new = session()
            return None if new == old else new

        before = wait_for(f"a worker after the death of {part}", replaced, 45)
