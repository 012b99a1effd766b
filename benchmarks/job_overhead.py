"""Where the CPU time of a job goes: the stages, and everything around them.

    python benchmarks/job_overhead.py [--rods 300] [--quality draft] [--slots N]

Starts `stickslip up` in a directory of its own, waits until all processes are idle, submits a job
of rods with four views each (a simulation and a render a rod, and a pack and a publish task or
more), and reads the CPU time of every process of the service from /proc. What the stages took is
what their tasks measured themselves; the rest of the processes that run them counts as overhead,
like the coordinator, the dispatcher and Ray. What it costs to start the service, Blender above all,
is printed apart: it is paid once.
"""

import argparse
import itertools
import os
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import httpx
from thesis_job import service

TICKS = os.sysconf("SC_CLK_TCK")

PARTS = (
    ("-m stickslip_services.app", "coordinator"),
    ("-m stickslip_workers head", "Ray: other"),
    ("-m stickslip_workers", "dispatcher"),
    ("ray::DashboardAgent", "Ray: agents"),
    ("ray::RuntimeEnvAgent", "Ray: agents"),
    ("raylet/raylet", "Ray: raylet"),
    ("gcs/gcs_server", "Ray: gcs"),
    ("ray::", "stage and render processes"),
    ("ray/", "Ray: other"),
    ("stickslip up", "supervisor"),
)
HOSTS = "stage and render processes"


def rods(count: int, quality: str) -> dict[str, Any]:
    """Return the spec of `count` rods with four views."""
    axes = {
        "gamma": {"type": "linspace", "start": 100, "stop": 1300, "num": count},
        "phi0": 1.0,
        "phi1": 6.0,
    }
    return {
        "kind": "rod_hang",
        "axes": axes,
        "views": "rod-4",
        "quality": quality,
        "samples_per_shard": 100,
    }


class Accounts:
    """CPU times of all processes of a service, ended ones included, up to the last look."""

    def __init__(self, marker: str) -> None:
        self._marker = marker
        self._seconds: dict[tuple[int, str], tuple[str, float]] = {}

    def look(self) -> None:
        """Read /proc."""
        parents, lines, stats = {}, {}, {}
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                try:
                    fields = (entry / "stat").read_text().rpartition(")")[2].split()
                    line = (
                        (entry / "cmdline")
                        .read_bytes()
                        .replace(b"\0", b" ")
                        .decode(errors="replace")
                    )
                except OSError:
                    continue
                pid = int(entry.name)
                parents[pid], lines[pid], stats[pid] = int(fields[1]), line, fields
        for pid, fields in stats.items():
            if not self._is_ours(pid, parents, lines):
                continue
            part = next(
                (name for text, name in PARTS if text in lines[pid]), f"other: {lines[pid][:60]}"
            )
            known = self._seconds.get((pid, fields[19]))
            if known is not None and part.startswith(("other", "Ray: agents")):
                part = known[0]
            self._seconds[pid, fields[19]] = part, (int(fields[11]) + int(fields[12])) / TICKS

    def by_part(self) -> dict[str, float]:
        """Return the CPU seconds of each part."""
        totals: dict[str, float] = defaultdict(float)
        for part, seconds in self._seconds.values():
            totals[part] += seconds
        return totals

    def _is_ours(self, pid: int, parents: dict[int, int], lines: dict[int, str]) -> bool:
        while pid > 1:
            if self._marker in lines.get(pid, ""):
                return True
            pid = parents.get(pid, 0)
        return False


def wait_until_idle(accounts: Accounts) -> None:
    """Wait until all processes have been started: until they take less than a tenth of a core."""
    while True:
        before = sum(accounts.by_part().values())
        time.sleep(2)
        accounts.look()
        if sum(accounts.by_part().values()) - before < 0.2:
            return


def run_job(client: httpx.Client, spec: dict[str, Any], accounts: Accounts) -> dict[str, Any]:
    """Run a job and return it."""
    job = client.post("/v1/jobs", json=spec).raise_for_status().json()["id"]
    for look in itertools.count():
        time.sleep(0.5)
        accounts.look()
        if look % 6 == 5:  # asking costs the coordinator something, too
            state: dict[str, Any] = client.get(f"/v1/jobs/{job}").json()
            if state["finished_at"] is not None:
                return state
    raise AssertionError


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rods", type=int, default=300)
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--port", type=int, default=9311)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, service(Path(folder), options.port) as client:
        accounts = Accounts(folder)
        accounts.look()
        wait_until_idle(accounts)
        started = accounts.by_part()
        load, begin = os.getloadavg()[0], time.perf_counter()
        job = run_job(client, rods(options.rods, options.quality), accounts)
        wall = time.perf_counter() - begin
        accounts.look()
        spent = {
            part: seconds - started.get(part, 0.0) for part, seconds in accounts.by_part().items()
        }
        stages = {stage: entry["cpu_seconds"] for stage, entry in job["progress"]["stages"].items()}
        tasks = sum(sum(entry["counts"].values()) for entry in job["progress"]["stages"].values())
    assert job["state"].startswith("succeeded"), job["message"]
    in_stages, total = sum(stages.values()), sum(spent.values())
    spent["around the tasks, in their processes"] = spent.pop(HOSTS) - in_stages
    print(
        f"{tasks} tasks in {wall:.0f} s, load {load:.1f} before and {os.getloadavg()[0]:.1f} after"
    )
    print(f"to start the service: {sum(started.values()):.1f} CPU s")
    for part, seconds in sorted(started.items(), key=lambda item: -item[1]):
        print(f"    {part:45} {seconds:7.2f}")
    print(f"the job: {total:.1f} CPU s")
    for stage, seconds in stages.items():
        print(f"    {stage:45} {seconds:7.2f}  {seconds / total:6.1%}")
    outside = 0.0
    for part, seconds in sorted(spent.items(), key=lambda item: -item[1]):
        print(
            f"    {part:45} {seconds:7.2f}  {seconds / total:6.1%}  {1e3 * seconds / tasks:6.1f} "
            "ms a task"
        )
        outside += seconds
    work = sum(stages[stage] for stage in ("simulate", "render", "pack") if stage in stages)
    print(
        f"outside simulate, render and pack: {total - work:.2f} CPU s, {(total - work) / total:.1%}"
    )


if __name__ == "__main__":
    main()
