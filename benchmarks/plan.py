"""Time and memory of planning a job of many samples, over HTTP.

The queue is empty or full.

    python benchmarks/plan.py [--samples 100000]

Prints one JSON object: for each job until it was accepted, and until all of it was planned.
`million.py` measures what others notice of it.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from stickslip_schemas.plan.builds import Builds


def spec(samples: int, *, start: float) -> dict[str, Any]:
    """Return a grid of rods with so many samples."""
    axis = {"type": "linspace", "start": start, "stop": start + 100.0, "num": samples // 100}
    ten = {"type": "linspace", "start": 0.0, "stop": 10.0, "num": 10}
    return {"kind": "rod_hang", "axes": {"gamma": axis, "phi0": ten, "phi1": ten}}


def peak_megabytes(pid: int) -> float:
    """Return the peak resident memory of a process [MB]."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024 / 1e6
    raise ValueError("no VmHWM")


@contextmanager
def coordinator(data: Path) -> Iterator[tuple[httpx.Client, int]]:
    """Run a coordinator in a process of its own, with a worker for rods.

    Yield a client and the process id.
    """
    command = [sys.executable, "-m", "stickslip_services.app", "--data", str(data), "--port", "0"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        url = process.stdout.readline().split()[-1]
        try:
            with httpx.Client(base_url=url, timeout=120) as client:
                builds = dict.fromkeys(Builds.model_fields, "a" * 64)
                worker = {
                    "name": "bench",
                    "builds": {"rod_hang": builds},
                    "condition": {"slots": 1},
                    "versions": {},
                }
                key = {"Authorization": f"Bearer {(data / 'worker-key').read_text().strip()}"}
                client.post("/v1/workers", json=worker, headers=key).raise_for_status()
                yield client, process.pid
        finally:
            process.terminate()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=100_000)
    samples = parser.parse_args().samples
    result: dict[str, Any] = {"samples": samples}
    with tempfile.TemporaryDirectory() as data, coordinator(Path(data)) as (client, pid):
        for name, start in (("first", 0.0), ("second", 500.0), ("same_again", 0.0)):
            begin = time.perf_counter()
            response = client.post("/v1/jobs", json=spec(samples, start=start))
            result[f"{name}_seconds"] = round(time.perf_counter() - begin, 3)
            job = response.raise_for_status().json()
            while job["state"] == "planning":
                time.sleep(0.05)
                job = client.get(f"/v1/jobs/{job['id']}").json()
            result[f"{name}_planned_seconds"] = round(time.perf_counter() - begin, 3)
            result["tasks"] = job["progress"]["total"]
        result["coordinator_peak_mb"] = round(peak_megabytes(pid), 1)
        result["database_mb"] = round((Path(data) / "coordinator.sqlite3").stat().st_size / 1e6, 1)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
