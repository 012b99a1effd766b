"""Simulate drop-and-drag for training, and pack meshes of the instants that clips show.

    python benchmarks/training/cloth_runs.py RUNS [--fabrics NAME ...] [--runs 30] [--vertices 21]
        [--preset fast] [--density LOW HIGH] [--bending LOW HIGH] [--stretching LOW HIGH] [--seed 0]
        [--frames 300] [--self-friction F] [--pack FILE]

Each run is a file of RUNS, and a call goes on where another stopped; two may share a folder. mu is
a Sobol sequence of [0, 1.6] for each fabric, and every run has a seed of its own, so that both
sides occur. With a range of factors the numbers of each run's fabric are multiplied by a factor of
its own, spread evenly over the logarithm: further dimensions of the same sequence. `--pack` writes
all runs of the folder into one file, as `stickslip_training.cloth.runs` reads it: positions in
whole steps of 10 um. Runs of finer meshes are packed at the vertices of the coarsest, by cubic
splines.
"""

import argparse
import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

for _library in ("OMP", "OPENBLAS", "MKL"):  # threads that wait for one another count as CPU time
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import numpy as np  # noqa: E402
from scipy.interpolate import make_interp_spline  # noqa: E402
from scipy.stats import qmc  # noqa: E402
from stickslip_schemas.spec.arrays import shown_frames  # noqa: E402
from stickslip_sim_core import build_info, fabric_names  # noqa: E402
from stickslip_sim_core import fabric as fabric_named  # noqa: E402
from stickslip_sim_core.scenes import cloth_drag  # noqa: E402
from stickslip_training.cloth.runs import STEP, grid_order  # noqa: E402

CLIP_FRAMES = 30  # frames of a clip
FRAMES = 300  # of a simulation
MU = 1.6
DROPPED = 17  # the first instant after the drop

FACTORS = ("density", "bending", "stretching")


@dataclass(frozen=True)
class Point:
    """What a run is of, besides its fabric."""

    mu: float
    factors: dict[str, float]
    """Of the fabric's numbers, by name."""


def points(
    fabric: str, runs: int, seed: int, ranges: dict[str, tuple[float, float]]
) -> list[Point]:
    """Return the points of the runs of a fabric.

    They are a scrambled Sobol sequence over mu and the factors that vary.
    """
    varied = [name for name in FACTORS if ranges[name][0] < ranges[name][1]]
    engine = qmc.Sobol(
        1 + len(varied), seed=np.random.default_rng((seed, fabric_names().index(fabric)))
    )
    count = 1 << (runs - 1).bit_length()
    points = []
    for mu, *shares in engine.random(count)[:runs].tolist():
        factors = {name: ranges[name][0] for name in FACTORS}
        for name, share in zip(varied, shares, strict=True):
            low, high = ranges[name]
            factors[name] = round(low * (high / low) ** share, 6)
        points.append(Point(round(MU * mu, 6), factors))
    return points


def instants_of(frames: int) -> list[int]:
    """Return the simulated instants that clips show."""
    return [instant for instant in shown_frames(CLIP_FRAMES, FRAMES) if instant < frames]


def simulate(
    name: str,
    point: Point,
    vertices: int,
    preset: str,
    seed: int,
    frames: int,
    self_friction: float | None,
) -> dict[str, object]:
    """Run one simulation, and return what is kept of it."""
    started = time.process_time()
    fabric = fabric_named(name).scaled(**point.factors)
    scene = cloth_drag.scene(
        fabric,
        point.mu,
        mesh=vertices,
        preset=preset,
        seed=seed,
        frames=frames,
        self_friction=self_friction,
    ).run()
    held = scene.rest[:, 1].argmax()
    free = scene.rest[:, 1].argmin()
    edges = [np.isclose(scene.rest[:, 1], scene.rest[vertex, 1]) for vertex in (held, free)]
    fell = (
        scene.positions[DROPPED, edges[1], 0].mean() - scene.positions[DROPPED, edges[0], 0].mean()
    )
    about = {
        "material": name,
        "mu": point.mu,
        "areal_density": fabric.density,
        "bending_rigidity": np.diag(fabric.rigidity).tolist(),
        "factors": point.factors,
        "seed": seed,
        "bias_side": scene.labels["bias_side"],
        "landed_side": 1 if fell > 0 else -1,
        "vertices": vertices,
        "preset": preset,
        "self_friction": self_friction,
        "build": build_info().build_hash,
        "valid": scene.valid,
        "reason": scene.reason,
        "cpu_s": round(time.process_time() - started, 2),
    }
    instants = instants_of(frames)
    positions = (
        scene.positions[instants] if scene.valid else np.zeros((len(instants), len(scene.rest), 3))
    )
    return {
        "positions": np.round(positions / STEP).astype(np.int16),
        "rest": scene.rest.astype(np.float32),
        "triangles": scene.triangles.astype(np.int16),
        "instants": np.array(instants, np.int16),
        "about": json.dumps(about),
    }


def at_vertices(run: dict[str, Any], rest: Any) -> Any:
    """Return the positions of a run at the vertices of a coarser mesh, (frames, V, 3)."""
    if np.array_equal(run["rest"], rest):
        return run["positions"]
    order = grid_order(rest)
    grid = run["positions"][:, grid_order(run["rest"])]
    places = np.linspace(0, 1, len(order))
    for axis in (1, 2):
        grid = make_interp_spline(np.linspace(0, 1, grid.shape[axis]), grid, axis=axis)(places)
    at = np.empty((len(grid), len(rest), 3), np.int16)
    at[:, order] = np.round(grid)
    return at


def write_packed(file: Path, positions: Any, mesh: Mapping[str, Any], about: Sequence[str]) -> None:
    """Write positions (runs, frames, V, 3) in whole steps of `STEP`.

    `mesh` has rest, triangles and instants.
    """
    # Differences of consecutive instants, low and high bytes apart, pack best.
    differences = np.diff(positions, axis=1, prepend=np.int16(0))
    bytes_apart = np.ascontiguousarray(differences).view(np.uint8).reshape(*differences.shape, 2)
    np.savez_compressed(
        file,
        differences=np.moveaxis(bytes_apart, -1, 0),  # (2, runs, frames, V, 3)
        **{name: mesh[name] for name in ("rest", "triangles", "instants")},
        about=np.array(about),
    )


def pack(folder: Path, file: Path) -> None:
    """Write the valid runs of a folder into one file."""
    runs = []
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as run:
            if json.loads(str(run["about"]))["valid"]:
                runs.append({name: run[name] for name in run.files})
    first = min(runs, key=lambda run: len(run["rest"]))
    for run in runs:
        finer = len(run["rest"]) > len(first["rest"])
        corners, wanted = (
            np.stack([mesh["rest"].min(axis=0), mesh["rest"].max(axis=0)]) for mesh in (run, first)
        )
        if not (
            np.allclose(corners, wanted, atol=1e-6)
            and np.array_equal(run["instants"], first["instants"])
            and (finer or np.array_equal(run["triangles"], first["triangles"]))
        ):
            raise ValueError(
                f"the runs in {folder} must be of one square and as many frames: pack a "
                "folder for each"
            )
        run["positions"] = at_vertices(run, first["rest"])
    about = [str(run["about"]) for run in runs]
    write_packed(file, np.stack([run["positions"] for run in runs]), first, about)
    print(f"{file}: {len(runs)} runs, {file.stat().st_size / 1e6:.2f} MB")


def main() -> None:
    """Simulate what the folder does not have yet."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--fabrics", nargs="+", default=list(fabric_names()))
    parser.add_argument("--runs", type=int, default=30, help="of each fabric")
    parser.add_argument("--vertices", type=int, default=21)
    parser.add_argument("--preset", default="fast")
    for name in FACTORS:
        parser.add_argument(
            f"--{name}", type=float, nargs=2, default=(1.0, 1.0), metavar=("LOW", "HIGH")
        )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--frames", type=int, default=FRAMES, help="to simulate, 2.4 a second; all are 300"
    )
    parser.add_argument(
        "--self-friction",
        type=float,
        help="of the cloth with itself; none: it passes through itself",
    )
    parser.add_argument("--pack", type=Path, help="simulate nothing, and write this file")
    args = parser.parse_args()
    if args.pack is not None:
        pack(args.folder, args.pack)
        return
    ranges = {name: tuple(getattr(args, name)) for name in FACTORS}
    if any(not 0 < low <= high for low, high in ranges.values()):
        parser.error(f"ranges of factors must have 0 < LOW <= HIGH, and are {ranges}")
    args.folder.mkdir(parents=True, exist_ok=True)
    for number in range(args.runs):
        for fabric in args.fabrics:
            path = (
                args.folder / f"{fabric}-{args.vertices}-{args.preset}-{args.seed}-{number:03d}.npz"
            )
            claim = path.with_suffix(".claim")
            try:
                claim.touch(exist_ok=False)
            except FileExistsError:
                continue  # done, or another process is at it
            point = points(fabric, args.runs, args.seed, ranges)[number]
            seed = int(
                np.random.SeedSequence(
                    (args.seed, fabric_names().index(fabric), number)
                ).generate_state(1)[0]
            )
            run = simulate(
                fabric,
                point,
                args.vertices,
                args.preset,
                seed % 2**31,
                args.frames,
                args.self_friction,
            )
            np.savez_compressed(path, **run)  # type: ignore[arg-type]  # its stub takes no objects
            print(run["about"], flush=True)


if __name__ == "__main__":
    main()
