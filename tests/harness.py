"""A real service for tests across components: coordinator, dispatcher, Ray and Blender under one
directory.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import httpx
import numpy as np
import numpy.typing as npt
import zarr
from stickslip_workers.cluster import head_directory
from zarr.abc.store import Store as ZarrStore

T = TypeVar("T")

STICKSLIP = Path(sys.executable).with_name("stickslip")


PATIENCE = 5.0
"""How many times as long as on a quiet machine something may take beside other tests, whose load
nobody knows. The times themselves are printed; `benchmarks/results/faults.json` has those of quiet
machines."""


def wait_for(condition: str, probe: Callable[[], T | None], timeout: float) -> T:
    """Poll `probe` until it returns something.

    Fail naming `what` after PATIENCE times `timeout` seconds.
    """
    timeout *= PATIENCE
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        answer = probe()
        if answer is not None:
            return answer
        time.sleep(0.05)
    raise AssertionError(f"waited {timeout:g} s in vain for {condition}")


def pids() -> list[int]:
    """Return the pids of all processes."""
    return [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit()]


def command_line(pid: int) -> str:
    """Return a process's command line; empty where there is no such process."""
    try:
        return (
            Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        )
    except OSError:
        return ""


def log_of(pid: int) -> str:
    """Return where a process writes its standard output; empty where there is no such process."""
    try:
        return str(Path(f"/proc/{pid}/fd/1").readlink())
    except OSError:
        return ""


def descendants(pid: int) -> list[int]:
    """Return the pids of a process's children, their children and so on."""
    parents: dict[int, list[int]] = {}
    for child in pids():
        try:
            stat = Path(f"/proc/{child}/stat").read_text()
        except OSError:
            continue
        parents.setdefault(int(stat.rpartition(")")[2].split()[1]), []).append(child)
    children, heads = [], [pid]
    while heads:
        heads = [child for head in heads for child in parents.get(head, [])]
        children += heads
    return children


class Service:
    """`stickslip up` on a free port, with everything below `data`."""

    def __init__(self, data: Path, *options: str) -> None:
        self.data = data
        self.options = options
        """Other options of `stickslip up`."""
        self.process: subprocess.Popen[bytes] | None = None
        self.url = ""

    def start(self) -> None:
        """Start, and wait until the coordinator answers."""
        (self.data / "url").unlink(missing_ok=True)
        self.data.mkdir(parents=True, exist_ok=True)
        with (self.data / "up.log").open("ab") as log:
            self.process = subprocess.Popen(
                [STICKSLIP, "up", "--data", self.data, "--port", "0", *self.options],
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        self.url = wait_for("the coordinator", self._ready_url, 180)

    def _ready_url(self) -> str | None:
        assert self.process is not None
        assert self.process.poll() is None, (self.data / "up.log").read_text()
        try:
            url = (self.data / "url").read_text().strip()
            return url if httpx.get(f"{url}/readyz").status_code == 200 else None
        except (OSError, httpx.TransportError):
            return None

    def stop(self) -> None:
        """Stop as Ctrl-C does, and expect it to be over in time."""
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            self.process.wait(timeout=60 * PATIENCE)

    def kill(self) -> None:
        """Kill the supervisor without a word."""
        assert self.process is not None
        self.process.kill()
        self.process.wait(timeout=10 * PATIENCE)

    def child(self, module: str) -> int:
        """Return the pid of the supervisor's child that runs `module`."""
        assert self.process is not None
        supervisor = self.process.pid

        def probe() -> int | None:
            return next(
                (pid for pid in descendants(supervisor) if f"-m {module}" in command_line(pid)),
                None,
            )

        return wait_for(f"a process of {module}", probe, 60)

    def all_processes(self) -> list[int]:
        """Return all processes that hold a file below the data directory open, or name it: ours,
        alive or orphaned.
        """
        places = (str(self.data), str(head_directory(self.data)))
        return [
            pid
            for pid in pids()
            if pid != os.getpid()
            and any(place in command_line(pid) + log_of(pid) for place in places)
        ]

    def wait_for_end(self) -> None:
        """Expect that all processes end by themselves."""
        wait_for("the end of all processes", lambda: None if self.all_processes() else True, 10)

    def get(self, path: str) -> Any:
        """Return the JSON of a GET."""
        response = httpx.get(self.url + path, timeout=60)
        response.raise_for_status()
        return response.json()

    def submit(self, spec: dict[str, Any]) -> str:
        """Submit a job and return its id."""
        response = httpx.post(f"{self.url}/v1/jobs", json=spec, timeout=60)
        assert response.status_code == 202, response.text
        return str(response.json()["id"])

    def finished(self, job: str, timeout: float = 240) -> dict[str, Any]:
        """Wait until a job is over, through restarts of the coordinator, and return it."""

        def probe() -> dict[str, Any] | None:
            try:
                answer: dict[str, Any] = self.get(f"/v1/jobs/{job}")
            except httpx.TransportError:
                return None
            return answer if answer["finished_at"] is not None else None

        return wait_for(f"the end of {job}", probe, timeout)


def read_arrays(place: Path | str | ZarrStore) -> dict[str, npt.NDArray[Any]]:
    """Return all arrays of a dataset, on disk, at a URL or in a store of Zarr, as zarr-python reads
    them.
    """
    group = zarr.open_group(place, mode="r")
    return {name: np.asarray(array[:]) for name, array in group.arrays()}
