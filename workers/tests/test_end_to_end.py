"""The command line against the real coordinator and the real renderer, each in its own process."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import httpx
import pytest
import zarr
from stickslip_workers.cluster import head_directory
from stickslip_workers.settings import default_blender_python

pytest.importorskip("stickslip_services")
pytestmark = [
    pytest.mark.real,
    pytest.mark.slow,  # tests/test_chaos.py ends dispatchers of a whole service, too
    pytest.mark.skipif(
        not default_blender_python().exists(), reason="there is no Blender environment"
    ),
]

T = TypeVar("T")
NAME = f"end-to-end-{os.getpid()}"


def _wait_for(condition: str, probe: Callable[[], T | None], timeout: float = 600) -> T:
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        if (answer := probe()) is not None:
            return answer
        time.sleep(0.05)
    raise AssertionError(f"waited {timeout} s in vain for {condition}")


class Services:
    """A coordinator, and dispatchers one after the other."""

    def __init__(self, directory: Path) -> None:
        self.store = directory / "store"
        self._directory = directory
        self._processes: list[subprocess.Popen[bytes]] = []
        self._start("coordinator", "stickslip_services.app", "--data", directory, "--port", "0")
        match = self._wait_for_line("coordinator", r"listening on (http://\S+)")
        self.url = match[1]

    def _start(self, log: str, *command: object) -> subprocess.Popen[bytes]:
        with (self._directory / f"{log}.log").open("wb") as file:
            words = [sys.executable, "-m", *map(str, command)]
            process = subprocess.Popen(words, stdout=file, stderr=subprocess.STDOUT)
        self._processes.append(process)
        return process

    def _wait_for_line(self, log: str, pattern: str) -> re.Match[str]:
        path = self._directory / f"{log}.log"
        return _wait_for(f"{pattern!r} in {log}.log", lambda: re.search(pattern, path.read_text()))

    def dispatch(self, log: str) -> subprocess.Popen[bytes]:
        process = self._start(
            log,
            "stickslip_workers",
            "dispatch",
            "--url",
            self.url,
            "--store",
            self.store,
            "--name",
            NAME,
            "--key-file",
            self.store.parent / "worker-key",
            "--max-cpus",  # so that one can kill it in the middle of a job, however many there are
            "1",
        )
        self._wait_for_line(log, "registered as")
        return process

    def submit(self, count: int) -> str:
        spec = {
            "kind": "rod_hang",
            "axes": {
                "gamma": {"type": "linspace", "start": 100.0, "stop": 900.0, "num": count},
                "phi0": 2,
                "phi1": 8,
            },
            "samples_per_shard": 8,
            "quality": "draft",
        }
        for axis in ("phi0", "phi1"):
            spec["axes"][axis] = float(spec["axes"][axis])
        response = httpx.post(f"{self.url}/v1/jobs", json=spec, timeout=30)
        assert response.status_code == 202, response.text
        return str(response.json()["id"])

    def job(self, job: str) -> dict[str, Any]:
        answer: dict[str, Any] = httpx.get(f"{self.url}/v1/jobs/{job}", timeout=30).json()
        return answer

    def close(self) -> None:
        for process in reversed(self._processes):
            process.terminate()
        for process in self._processes:
            process.wait(timeout=150)


@pytest.fixture
def services(tmp_path: Path) -> Iterator[Services]:
    running = Services(tmp_path)
    yield running
    running.close()


def _processes() -> list[int]:
    """Return the processes of the Ray of the dispatchers."""
    place, pids = str(head_directory(Path(NAME))), []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if entry.name.isdigit() and place in (entry / "cmdline").read_text(errors="replace"):
                pids.append(int(entry.name))
    return pids


def test_killing_the_dispatcher_loses_and_leaves_nothing(services: Services) -> None:
    first = services.dispatch("first")
    job = services.submit(24)

    def some_rendered() -> bool | None:
        stages = services.job(job)["progress"][
            "stages"
        ]  # empty before the dispatcher says what it makes
        return (
            True
            if 1 < stages.get("render", {"counts": {}})["counts"].get("succeeded", 0) < 24
            else None
        )

    _wait_for("some renders", some_rendered)
    assert _processes()
    first.send_signal(signal.SIGKILL)
    first.wait()

    second = services.dispatch("second")
    done = _wait_for(
        "the end of the job", lambda: (now := services.job(job))["finished_at"] and now
    )
    assert done["state"] == "succeeded"
    version = (
        services.store / "datasets" / done["dataset"]["dataset"] / f"v{done['dataset']['version']}"
    )
    group = zarr.open_group(version, mode="r")
    assert group["valid"][...].all()
    assert (group["views"][...].reshape(24, -1).max(axis=1) > 0).all()

    second.send_signal(signal.SIGTERM)
    assert second.wait(timeout=150) == 0
    _wait_for("the end of Ray's processes", lambda: True if not _processes() else None, 10)
