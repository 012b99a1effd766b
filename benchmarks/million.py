"""A job of a million samples, with workers that only pretend: what the service itself costs.

    python benchmarks/million.py plan [--samples 1000000]

`plan`: how long the answer to the submission takes; then, while the coordinator plans, how long leases of another job
take, and what planning costs it. Prints one JSON object.
"""

import argparse
import json
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx
from plan import coordinator, peak_megabytes, spec

BEFORE_SECONDS = 5.0
"""How long leases are measured while nothing is planned [s]."""


def cpu_seconds(pid: int) -> float:
    """Return the CPU time that a process has used [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Worker:
    """Leases ten tasks of a job and gives them back, over and over."""

    def __init__(self, client: httpx.Client, key: str, worker_id: str) -> None:
        self._client = client
        self._headers = {"Authorization": f"Bearer {key}"}
        self._id = worker_id

    def lease(self) -> float:
        """Return how long a lease takes [s]; give the tasks back."""
        begin = time.perf_counter()
        leases = self._post("lease", {"worker_id": self._id, "wanted": {"simulate": 10}})["leases"]
        seconds = time.perf_counter() - begin
        assert len(leases) == 10, "there must be tasks to lease"
        reports = [{"task_id": lease["task_id"], "token": lease["token"], "result": None} for lease in leases]
        self._post("report", {"worker_id": self._id, "reports": reports})
        return seconds

    def _post(self, verb: str, document: dict[str, Any]) -> dict[str, Any]:
        answer = self._client.post(f"/v1/worker/{verb}", json=document, headers=self._headers)
        return answer.raise_for_status().json()  # type: ignore[no-any-return]


def told(seconds: list[float]) -> dict[str, float]:
    """Return the median, the 99th percentile and the longest of some times [s]."""
    ordered = sorted(seconds)
    return {
        "count": len(ordered),
        "median": round(statistics.median(ordered), 4),
        "p99": round(ordered[int(0.99 * (len(ordered) - 1))], 4),
        "longest": round(ordered[-1], 4),
    }


def plan(samples: int) -> dict[str, Any]:
    """Measure the submission and the planning of a job."""
    with tempfile.TemporaryDirectory() as directory, coordinator(Path(directory)) as (client, pid):
        key = (Path(directory) / "worker-key").read_text().strip()
        worker = Worker(client, key, client.get("/v1/workers").json()[0]["id"])
        client.post("/v1/jobs", json=spec(1000, start=900.0), params={"priority": 5}).raise_for_status()
        before: list[float] = []
        end = time.perf_counter() + BEFORE_SECONDS
        while time.perf_counter() < end:
            before.append(worker.lease())
            time.sleep(0.05)
        cpu, begin = cpu_seconds(pid), time.perf_counter()
        job = client.post("/v1/jobs", json=spec(samples, start=0.0)).raise_for_status().json()
        result: dict[str, Any] = {"samples": samples, "submit_seconds": round(time.perf_counter() - begin, 3)}
        during: list[float] = []
        while job["state"] == "planning":
            during.append(worker.lease())
            time.sleep(0.05)
            if len(during) % 10 == 0:
                job = client.get(f"/v1/jobs/{job['id']}").json()
        result["planning_seconds"] = round(time.perf_counter() - begin, 1)
        result["coordinator_cpu_seconds"] = round(cpu_seconds(pid) - cpu, 1)
        result["state"], result["tasks"] = job["state"], job["progress"]["total"]
        result["lease_seconds_before"], result["lease_seconds_while_planning"] = told(before), told(during)
        result["coordinator_peak_mb"] = round(peak_megabytes(pid), 1)
        result["database_mb"] = round((Path(directory) / "coordinator.sqlite3").stat().st_size / 1e6, 1)
    return result


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("plan",))
    parser.add_argument("--samples", type=int, default=1_000_000)
    arguments = parser.parse_args()
    print(json.dumps({"plan": plan}[arguments.what](arguments.samples), indent=2))


if __name__ == "__main__":
    main()
