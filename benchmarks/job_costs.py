"""What jobs cost beside what `stickslip validate` says before anything was measured.

    python benchmarks/job_costs.py [--only 0 1 2] [--port 9312]

Runs the jobs one after the other in a service of its own, and prints a JSON object for each: CPU
seconds by stage as the tasks measured them, and the estimate of the package with its interval [s].
No two jobs share a task. The first job of rods and the first of cloth pay for the start of Blender.
"""

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.costs import count, estimate_cost
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
    uncertified = {"allow_uncertified": True, "mesh": 21, "preset": "fast"}
    return {
        "kind": "cloth_drag",
        "axes": axes,
        "quality": quality,
        "frames": frames,
        **uncertified,
        **more,
    }


JOBS = [
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
]


def measured(client: httpx.Client, document: dict[str, Any]) -> dict[str, Any]:
    """Run a job; return its cost by stage and the estimate of the package [s]."""
    spec = job_spec_adapter.validate_python(document)
    usual = estimate_cost(spec, count(spec), {}, 1)
    load = os.getloadavg()[0]
    job = client.post("/v1/jobs", json=document).raise_for_status().json()["id"]
    while (state := client.get(f"/v1/jobs/{job}").json())["finished_at"] is None:
        time.sleep(0.5)
    assert state["state"].startswith("succeeded"), state["message"]
    stages = {
        name: round(stage["cpu_seconds"], 2) for name, stage in state["progress"]["stages"].items()
    }
    total, said = sum(stages.values()), usual.cpu_seconds
    return {
        "job": {name: value for name, value in document.items() if name != "allow_uncertified"},
        "cpu seconds": stages,
        "estimate": {name: round(stage.median, 2) for name, stage in usual.stages.items()},
        "total": round(total, 2),
        "estimate of the total, low, median, high": [
            round(said.low, 2),
            round(said.median, 2),
            round(said.high, 2),
        ],
        "ratio": round(total / said.median, 2),
        "within the interval": said.low <= total <= said.high,
        "load": round(load, 1),
    }


def main() -> None:
    """Run the jobs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", type=int, nargs="*")
    parser.add_argument("--port", type=int, default=9312)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, service(Path(folder), options.port) as client:
        for place in range(len(JOBS)) if options.only is None else options.only:
            print(json.dumps({"place": place} | measured(client, JOBS[place])), flush=True)


if __name__ == "__main__":
    main()
