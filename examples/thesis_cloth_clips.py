"""Make 768 clips of dragged cloth through the service, and report what they cost.

    .venv/bin/python examples/thesis_cloth_clips.py [--out DIR] [--certificate DIR] [--small]

4 fabrics x 8 friction coefficients x 8 textures x 3 viewpoints x 30 frames, on a mesh of 41 x 41.
Give the `--out` of `examples/thesis_cloth_simulations.py`, and its simulations and its certificate
are used. `--small` makes 24 clips of 6 frames on a coarse mesh instead, without a certificate. You
can stop the script and start it again.
"""

import argparse
import json
import sqlite3
import time
from collections import defaultdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from demo import console, run, service
from stickslip_schemas.format.manifest import Manifest
from stickslip_schemas.kinds.cloth_drag import ClothDragSpec
from stickslip_services.client.http import Client
from thesis_cloth_simulations import DATABASE

SPEC = Path(__file__).with_name("thesis-cloth-clips.yaml")


def main() -> None:
    """Submit, wait, pull, report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("thesis-cloth-out"))
    parser.add_argument(
        "--certificate", type=Path, help="what `stickslip certify --preset certified` wrote"
    )
    parser.add_argument(
        "--small", action="store_true", help="24 clips of 6 frames, mesh 13, not certified"
    )
    args = parser.parse_args()
    spec = yaml.safe_load(SPEC.read_text())
    if args.small:
        spec |= {
            "name": "small-cloth-clips",
            "preset": "fast",
            "mesh": 13,
            "frames": 6,
            "allow_uncertified": True,
        }
        spec["axes"] |= {"material": ["gray-interlock"], "mu": [0.5]}
    args.out.mkdir(exist_ok=True)
    begun = datetime.now(UTC)
    with service(args.out / "service") as url:
        if args.certificate is not None:
            run("stickslip", "register", args.certificate, "--url", url)
        wait_for_worker(url, begun)
        started = time.monotonic()
        path = args.out / f"{spec['name']}.yaml"
        path.write_text(yaml.safe_dump(spec))
        run("stickslip", "submit", path, "--watch", "--url", url)
        wall = time.monotonic() - started
        with Client(url) as client:
            job = next(client.jobs())
        if job.dataset is None:
            raise SystemExit(f"{job.id} is {job.state}: {job.message}")
        dataset = args.out / spec["name"]
        run("stickslip", "pull", job.dataset.dataset, dataset, "--url", url)
    run("stickslip", "verify", dataset)
    report(dataset, args.out / DATABASE, job.id, wall)


def wait_for_worker(url: str, since: datetime) -> None:
    """Wait until a worker has registered since then.

    A job is planned for the builds of the newest worker.
    """
    with Client(url) as client:
        while not any(worker.registered_at >= since for worker in client.workers()):
            time.sleep(1.0)


def report(dataset: Path, database: Path, job: str, wall: float) -> None:
    """Print the wall time of the job and the CPU seconds of its tasks, new and cached."""
    spent: dict[tuple[str, bool], list[float]] = defaultdict(list)
    with sqlite3.connect(f"file:{database}?mode=ro", uri=True) as connection:
        rows = connection.execute(
            "SELECT stage, cached, cpu_seconds FROM tasks "
            "JOIN job_tasks ON job_tasks.task = tasks.seq "
            "JOIN jobs ON jobs.seq = job_tasks.job "
            "WHERE jobs.id = ? AND tasks.cpu_seconds IS NOT NULL",
            (job,),
        )
        for stage, cached, seconds in rows:
            spent[stage, bool(cached)].append(seconds)
    manifest = Manifest.model_validate_json((dataset / "manifest.json").read_bytes())
    assert isinstance(manifest.spec, ClothDragSpec)
    length = manifest.spec.frames
    frames = manifest.valid_count * length
    console.rule("cost")
    console.print(
        f"{manifest.valid_count} of {manifest.sample_count} clips, {frames} frames in {wall:.0f} s"
    )
    for (stage, cached), seconds in sorted(spent.items()):
        when = "before" if cached else "now"
        console.print(
            f"  {stage:9} {len(seconds):5} tasks, {sum(seconds) / 3600:.3f} CPU h, made {when}"
        )
    rendering = spent["render", False]
    if rendering:
        console.print(
            f"  {sum(rendering) / (len(rendering) * length):.4f} CPU s per frame and texture"
        )
    files = {file.path: file.size for file in manifest.files}
    video = sum(size for path, size in files.items() if path.startswith("video/"))
    raw = frames * 224 * 224 * 3
    console.print(f"  video {video / 1e6:.0f} MB, {raw / max(video, 1):.2f} times smaller than raw")
    _print_labels(dataset)


def _print_labels(dataset: Path) -> None:
    """Print how good the worst clip is, and how large the cloth is in the frame."""
    import zarr

    group: Any = zarr.open_group(dataset, mode="r")
    valid = np.asarray(group["valid"])
    least = {
        f"{name}, least": float(np.nanmin(np.asarray(group[name])[valid]))
        for name in ("psnr_cloth", "psnr_edge")
    }
    quality = least | {"frame_share": float(np.asarray(group["frame_share"])[valid].mean())}
    console.print(f"  {json.dumps(quality)}")


if __name__ == "__main__":
    main()
