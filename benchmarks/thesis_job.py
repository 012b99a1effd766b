"""The thesis's 10,000 rods through the service.

It prints the time, the accepted samples, and the stages that lost samples.

python benchmarks/thesis_job.py [--rendered 300] [--port 9310] [--pages DIR]

Starts `stickslip up` in a directory of its own and submits two jobs: the whole grid without
renders, then a seeded random choice from its ranges with four views each, of draft quality. Prints
seconds from submission to the dataset, acceptance rates, and what the labels say. --pages keeps the
page of each dataset.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import yaml
from stickslip_schemas.format.manifest import Manifest
from stickslip_training.data.reader import DatasetReader

SPEC = Path(__file__).parents[1] / "examples" / "thesis-rods.yaml"
STICKSLIP = Path(sys.executable).with_name("stickslip")


def whole_grid() -> dict[str, Any]:
    """Return the spec of all 10,000 rods, nothing rendered."""
    return {
        **yaml.safe_load(SPEC.read_text()),
        "name": "thesis-all",
        "views": None,
        "samples_per_shard": 2000,
    }


def some_rendered(count: int) -> dict[str, Any]:
    """Return the spec of `count` rods drawn at random from the ranges of the grid, rendered."""
    spec = yaml.safe_load(SPEC.read_text())
    axes = {
        name: {
            "type": "random",
            "low": axis["start"],
            "high": axis["stop"],
            "num": count,
            "seed": seed,
        }
        for seed, (name, axis) in enumerate(spec["axes"].items())
    }
    return {**spec, "name": f"thesis-{count}", "axes": axes, "combine": "zip", "quality": "draft"}


@contextmanager
def service(data: Path, port: int) -> Iterator[httpx.Client]:
    """Run the service until the block ends."""
    command = [str(STICKSLIP), "up", "--data", str(data), "--port", str(port)]
    log = data / "up.log"
    with log.open("wb") as file:
        process = subprocess.Popen(command, stdout=file, stderr=file, start_new_session=True)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60) as client:
            deadline = time.monotonic() + 180
            while not _workers(client):
                if process.poll() is not None or time.monotonic() > deadline:
                    raise SystemExit(f"the service did not start:\n{log.read_text()[-3000:]}")
                time.sleep(0.2)
            yield client
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(timeout=60)


def _workers(client: httpx.Client) -> bool:
    try:
        return any(
            worker["condition"]["state"] == "ready" for worker in client.get("/v1/workers").json()
        )
    except httpx.TransportError:
        return False


def run_job(client: httpx.Client, spec: dict[str, Any]) -> tuple[float, str]:
    """Return the seconds from submission to the dataset, and where the dataset is."""
    start = time.perf_counter()
    job = client.post("/v1/jobs", json=spec).raise_for_status().json()["id"]
    while (state := client.get(f"/v1/jobs/{job}").json())["dataset"] is None:
        if state["state"] in ("failed", "cancelled"):
            raise SystemExit(f"job {job}: {state['state']}, {state['message']}")
        time.sleep(0.05)
    seconds = time.perf_counter() - start
    dataset = state["dataset"]
    return seconds, f"/v1/datasets/{dataset['dataset']}/versions/{dataset['version']}"


def describe(client: httpx.Client, where: str) -> str:
    """Return what a dataset says of itself: what was lost, and its labels."""
    manifest = Manifest.model_validate_json(client.get(f"{where}/manifest").content)
    reasons = manifest.rejection_counts
    size = client.get(where).json()["bytes"]
    with DatasetReader(f"{client.base_url}".rstrip("/") + where) as reader:
        slots = np.concatenate([reader.slots(split) for split in ("train", "validation", "test")])
        multistable, contact, reach = (
            reader.read(n, slots) for n in ("multistable", "self_contact_distance", "reach")
        )
    near = contact[np.isfinite(contact)]
    return (
        f"  accepted {manifest.valid_count} of {manifest.sample_count} "
        f"({manifest.acceptance_rate:.2%})"
        f"{f'; lost: {reasons}' if reasons else '; nothing was lost'}; {size / 1e6:.1f} MB\n"
        f"  multistable {multistable.mean():.2%}; come back to themselves "
        f"{len(near) / len(slots):.2%}, "
        f"nearest {near.min(initial=np.inf):.4f} L; reach median {np.median(reach):.3f}, largest "
        f"{reach.max():.3f} L"
    )


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--rendered", type=int, default=300, help="rods with views; 0: none")
    arguments.add_argument("--port", type=int, default=9310)
    arguments.add_argument("--pages", type=Path, help="folder that keeps the pages of the datasets")
    options = arguments.parse_args()
    jobs = [whole_grid()] + ([some_rendered(options.rendered)] if options.rendered else [])
    with tempfile.TemporaryDirectory() as folder, service(Path(folder), options.port) as client:
        for spec in jobs:
            load = os.getloadavg()[0]
            seconds, where = run_job(client, spec)
            print(
                f"{spec['name']}: {seconds:.1f} s from submission to dataset (load average before: "
                f"{load:.1f})"
            )
            print(describe(client, where))
            if options.pages:
                options.pages.mkdir(parents=True, exist_ok=True)
                (options.pages / f"{spec['name']}.html").write_text(
                    client.get(f"{where}/page").text
                )


if __name__ == "__main__":
    main()
