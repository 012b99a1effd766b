"""The cost of twelve jobs beside the estimate that a service gives before it runs them.

    python benchmarks/job_costs.py [--set fitted|held-out] [--only 0 1 2] [--port 9312]

The packaged costs were fitted to some jobs of the set `fitted`, and the widths of their intervals
to all of them. The jobs of `held-out` were chosen afterwards, before any of them had run: other
numbers, sizes of pictures, meshes, presets, and scenes.

Runs the jobs one after the other in a service of its own, and prints a JSON object for each: CPU
seconds by stage as the tasks measured them, wall seconds, and the estimates of `validate` with
their intervals [s]. Once a service has measured the simulations or renders of the next job, a fresh
one runs it, so every estimate is a packaged cost, scaled by the speed of the machine. Run it in a
control group with a CPU quota to see another speed. The last line sums up: how many intervals hold
the cost, and how many medians are within 1.6 times.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx
from stickslip_workers.machine import QUIET_SECONDS, SpeedGauge, speed_file
from thesis_job import service


def rods(number: int, quality: str) -> dict[str, Any]:
    """Return a job of rods with four views each."""
    gamma = {"type": "linspace", "start": 120, "stop": 1250, "num": number}
    return {
        "kind": "rod_hang",
        "axes": {"gamma": gamma, "phi0": 2.0, "phi1": 9.0},
        "quality": quality,
    }


def cloth(
    quality: str, frames: int, textures: str, material: str, mu: Any, **more: Any
) -> dict[str, Any]:
    """Return a job of dragged cloth; `textures` are names with blanks between."""
    axes = {"material": material, "mu": mu, "texture": textures.split(), "viewpoint": "calibrated"}
    axes |= more.pop("axes", {})
    uncertified = {"allow_uncertified": True, "mesh": 21, "preset": "fast"}
    return {
        "kind": "cloth_drag",
        "axes": axes,
        "quality": quality,
        "frames": frames,
        **uncertified,
        **more,
    }


def scene(name: str, quality: str, frames: int, textures: str, **more: Any) -> dict[str, Any]:
    """Return a job of a built-in scene; `textures` are names with blanks between."""
    axes = {"texture": textures.split(), "viewpoint": "front"}
    return {
        "kind": "cloth_scene",
        "scene": name,
        "axes": axes,
        "quality": quality,
        "frames": frames,
        "allow_uncertified": True,
        **more,
    }


FITTED_JOBS = [
    rods(24, "preview"),
    rods(60, "draft"),
    rods(30, "standard"),
    rods(12, "high"),
    cloth("preview", 30, "checker stripes", "royal-target", [0.3, 0.9]),
    cloth("draft", 20, "checker dots plaid gingham", "camel-ponte-roma", 0.6, preset="certified"),
    cloth("standard", 12, "houndstooth dots", "ivory-rib-knit", [0.2, 0.8]),
    cloth("draft", 24, "floral", "pink-ribbon-brown", 0.5, mesh=41),
    cloth(
        "standard",
        10,
        "plaid dots herringbone",
        "white-swim-solid",
        0.7,
        mesh=41,
        preset="certified",
    ),
    cloth("high", 8, "checker stripes", "tango-red-jet-set", 0.4, mesh=41),
    # 2,000 rods without pictures, and simulations with few small pictures.
    {**rods(2000, "draft"), "views": None},
    cloth("preview", 4, "gingham", "navy-sparkle-sweat", [0.1, 0.4, 1.0]),
    # Held out until their misses widened the intervals.
    rods(150, "draft"),
    {**rods(20, "high"), "resolution": [320, 240]},
    {**rods(80, "standard"), "resolution": [128, 128]},
    {**rods(6000, "draft"), "views": None},
    cloth(
        "draft",
        10,
        "plaid checker",
        "11oz-black-denim",
        [0.3, 0.9],
        axes={"viewpoint": ["calibrated", "left", "right"]},
        resolution=[128, 128],
    ),
    cloth(
        "standard",
        5,
        "stripes",
        "white-dots-on-blk",
        0.5,
        resolution=[320, 240],
        ground_truth=["depth", "segmentation"],
    ),
    cloth("preview", 8, "gingham", "gray-interlock", [0.25, 0.75], mesh=31),
    cloth("preview", 4, "dots", "royal-target", 0.6, preset="fine"),
    cloth(
        "preview",
        4,
        "dots argyle chevron",
        "camel-ponte-roma",
        [0.2, 1.2],
        mesh=31,
        preset="certified",
        self_friction=None,
    ),
    scene("turning-ball", "draft", 12, "checker floral"),
    scene("fling", "preview", 10, "dots"),
    scene("belt", "standard", 6, "plaid stripes", resolution=[240, 320]),
]

HELD_OUT_JOBS = [
    rods(400, "preview"),
    {**rods(45, "standard"), "resolution": [240, 400]},
    {**rods(16, "draft"), "resolution": [640, 480]},
    {**rods(12_000, "draft"), "views": None},
    cloth("draft", 16, "stripes floral", "gray-interlock", [0.2, 0.5, 0.9]),
    cloth("standard", 8, "plaid", "white-dots-on-blk", 0.45, mesh=41, resolution=[480, 360]),
    cloth("preview", 6, "checker", "11oz-black-denim", [0.2, 0.4, 0.6, 0.8], preset="certified"),
    cloth("draft", 5, "dots", "pink-ribbon-brown", 0.35, mesh=41, preset="certified"),
    cloth("high", 4, "houndstooth", "ivory-rib-knit", 0.8),
    scene("wipe", "draft", 8, "checker"),
    scene("fold-napkin", "preview", 12, "dots stripes"),
    scene("over-the-edge", "standard", 6, "plaid", resolution=[128, 128]),
]

SETS = {"fitted": FITTED_JOBS, "held-out": HELD_OUT_JOBS}


def run_job(client: httpx.Client, document: dict[str, Any]) -> dict[str, Any]:
    """Run a job; return its cost by stage, and the estimate of the service [s]."""
    load = os.getloadavg()[0]
    estimate = estimate_of(client, document)
    started_at = time.monotonic()
    job = client.post("/v1/jobs", json=document).raise_for_status().json()["id"]
    while (state := client.get(f"/v1/jobs/{job}").json())["finished_at"] is None:
        time.sleep(0.2)
    wall_seconds = time.monotonic() - started_at
    assert state["state"].startswith("succeeded"), state["message"]
    stages = {}
    for name, stage in state["progress"]["stages"].items():
        stages[name] = round(stage["cpu_seconds"], 2)
    return {
        "job": {name: value for name, value in document.items() if name != "allow_uncertified"},
        "cpu seconds by stage": stages,
        "estimate by stage": {n: round(s["median"], 2) for n, s in estimate["stages"].items()},
        "cpu": compare(sum(stages.values()), estimate["cpu_seconds"]),
        "wall": compare(wall_seconds, estimate["wall_seconds"]),
        "load": round(load, 1),
    }


def estimate_of(client: httpx.Client, document: dict[str, Any]) -> dict[str, Any]:
    """Return the estimate that a service gives for a job."""
    answer = client.post("/v1/jobs:validate", json=document).raise_for_status().json()
    estimate: dict[str, Any] = answer["estimate"]
    return estimate


def has_measured(client: httpx.Client, document: dict[str, Any]) -> bool:
    """Return whether a service knows costs of a job from tasks that it has run."""
    return not {"simulate", "render"}.isdisjoint(estimate_of(client, document)["measured"])


def compare(seconds: float, interval: dict[str, float]) -> dict[str, Any]:
    """Return a measured time beside the interval that was estimated [s]."""
    return {
        "measured": round(seconds, 2),
        "low, median, high": [round(interval[name], 2) for name in ("low", "median", "high")],
        "ratio": round(seconds / interval["median"], 2),
        "is covered": interval["low"] <= seconds <= interval["high"],
    }


def summarize(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return how many jobs the estimates are right for."""
    summary: dict[str, Any] = {"jobs": len(results)}
    for time_name in ("cpu", "wall"):
        comparisons = [result[time_name] for result in results]
        close = [c for c in comparisons if 1 / 1.6 <= c["ratio"] <= 1.6]
        summary[f"{time_name}: covered"] = sum(c["is covered"] for c in comparisons)
        summary[f"{time_name}: median within 1.6 times"] = len(close)
    return summary


def know_machine() -> None:
    """Measure the speed of this machine while nothing disturbs it, as an idle worker does."""
    gauge = SpeedGauge(speed_file(), os.cpu_count() or 1)
    while not gauge.is_settled:
        print("waiting for quiet CPUs", file=sys.stderr)
        time.sleep(QUIET_SECONDS)
        gauge.settle()


def wait_for_workers(client: httpx.Client) -> None:
    """Wait until a worker is ready; its first seconds are no part of a job."""
    while True:
        workers = client.get("/v1/workers").raise_for_status().json()
        entries = workers["items"] if isinstance(workers, dict) else workers
        if any(entry["condition"]["state"] == "ready" for entry in entries):
            return
        time.sleep(0.5)


def main() -> None:
    """Run the jobs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--set", choices=sorted(SETS), default="fitted")
    parser.add_argument("--only", type=int, nargs="*")
    parser.add_argument("--port", type=int, default=9312)
    options = parser.parse_args()
    jobs = SETS[options.set]
    indices = list(range(len(jobs)) if options.only is None else options.only)
    results = []
    know_machine()
    # Each turn starts a service, and runs the jobs of which it has measured no cost.
    while indices:
        with tempfile.TemporaryDirectory() as folder, service(Path(folder), options.port) as client:
            wait_for_workers(client)
            while indices and not has_measured(client, jobs[indices[0]]):
                index = indices.pop(0)
                result = {"index": index} | run_job(client, jobs[index])
                results.append(result)
                print(json.dumps(result), flush=True)
    print(json.dumps(summarize(results)))


if __name__ == "__main__":
    main()
