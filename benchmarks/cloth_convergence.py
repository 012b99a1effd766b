"""Convergence of drop-and-drag with the mesh and with the time step.

python benchmarks/cloth_convergence.py [--vertices 21 41 81] [--divisors 1 2 4] [--mu 0.5] [--frames
300]

Vertices a side are 20 k + 1, so that all meshes share those of the coarsest, which are compared at
every frame: meshes by the preset's own steps, each with the next finer one; and the preset's own
steps (divisor 1) with fixed steps, its `time_step` over the other divisors, on the coarsest mesh,
each with the shortest. Prints distances of vertices in mm over all frames and over those of the
steady first drag, with the CPU seconds of each simulation, one thread. The cloth passes through
itself, so that the step alone decides.
"""

import argparse
import os
import time
from dataclasses import replace
from itertools import pairwise

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from stickslip_sim_core import ClothRun, SolverSettings, build_info, preset_named
from stickslip_sim_core.scenes import cloth_drag
from stickslip_sim_core.scenes.cloth_drag import FRAME_RATE, FRAMES

STEADY = (22.0, 37.0)  # s


def divided(preset: SolverSettings, divisor: int) -> SolverSettings:
    """Return the preset (1), or one of fixed steps that share a frame."""
    if divisor == 1:
        return preset
    per_frame = int(np.ceil(1.0 / (FRAME_RATE * preset.time_step)))
    step = (1.0 + 1e-9) / (FRAME_RATE * per_frame * divisor)
    return replace(preset, name=f"{preset.name}, dt/{divisor}", step_error=None, time_step=step)


def simulate(args: argparse.Namespace, vertices: int, divisor: int) -> ClothRun:
    start = time.process_time()
    preset = divided(preset_named(args.preset), divisor)
    scene = cloth_drag.scene(
        args.material,
        args.mu,
        preset=preset,
        mesh=vertices,
        frames=args.frames,
        seed=args.seed,
        self_friction=None,
    ).run()
    seconds = time.process_time() - start
    print(
        f"  {vertices:3d} x {vertices:<3d} dt {1e3 * preset.time_step:7.3f} ms  {seconds:8.1f} CPU "
        "s  "
        f"{scene.labels['unconverged_steps']}/{scene.labels['steps']} steps unconverged  "
        f"worst residual {scene.labels['worst_residual']:.1e}  "
        f"crossings {int(scene.self_intersections.max())}  "
        f"{'valid' if scene.valid else scene.reason}",
        flush=True,
    )
    return scene


def shared(scene: ClothRun, vertices: int, coarsest: int) -> NDArray[np.float64]:
    """Return positions (frames, coarsest, coarsest, 3) of the vertices that all meshes have."""
    every = (vertices - 1) // (coarsest - 1)
    return scene.positions.reshape(len(scene.positions), vertices, vertices, 3)[:, ::every, ::every]


def compare(
    name: str, a: NDArray[np.float64], b: NDArray[np.float64], times: NDArray[np.float64]
) -> None:
    distance = 1e3 * np.linalg.norm(a - b, axis=-1)
    steady = distance[(times > STEADY[0]) & (times < STEADY[1])]
    for label, distances in (("all frames", distance), ("steady drag", steady)):
        if distances.size:
            print(
                f"  {name:24s} {label:12s} median {np.median(distances):7.3f}  "
                f"mean {distances.mean():7.3f}  "
                f"p95 {np.quantile(distances, 0.95):7.3f}  max {distances.max():7.3f} mm"
            )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--vertices", type=int, nargs="+", default=[21, 41], help="a side; 81 takes long"
    )
    parser.add_argument("--divisors", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--material", default="gray-interlock")
    parser.add_argument("--mu", type=float, default=0.5)
    parser.add_argument("--preset", default="certified")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    sides = sorted(args.vertices)
    if any((side - 1) % (sides[0] - 1) for side in sides):
        parser.error("vertices: all meshes must have those of the coarsest")

    build = build_info()
    print(
        f"stickslip-sim-core {build.version}  build {build.build_hash[:12]}  load "
        f"{os.getloadavg()[0]:.1f}"
    )
    print(
        f"drop-and-drag of {args.material}, mu {args.mu:g}, {args.frames} frames, preset "
        f"{args.preset}"
    )
    scenes = {(side, 1): simulate(args, side, 1) for side in sides}
    for divisor in sorted(set(args.divisors) - {1}):
        scenes[sides[0], divisor] = simulate(args, sides[0], divisor)
    frames = min(len(scene.positions) for scene in scenes.values())
    times = np.arange(frames) / FRAME_RATE
    paths = {key: shared(scene, key[0], sides[0])[:frames] for key, scene in scenes.items()}
    for coarse, fine in pairwise(sides):
        compare(f"mesh {coarse} and {fine}", paths[coarse, 1], paths[fine, 1], times)
    steps = sorted(divisor for side, divisor in paths if side == sides[0])
    for divisor in steps[:-1]:
        compare(
            f"dt/{divisor} and dt/{steps[-1]}",
            paths[sides[0], divisor],
            paths[sides[0], steps[-1]],
            times,
        )
    for (side, divisor), scene in scenes.items():
        steady = (scene.times > STEADY[0]) & (scene.times < STEADY[1])
        if steady.any():
            force = scene.record["contact_force"][steady]
            ratio = np.hypot(force[:, 0], force[:, 1]) / force[:, 2]
            print(
                f"  {side} dt/{divisor}: |Ft|/Fn over mu, steady drag: median "
                f"{np.median(ratio) / args.mu - 1.0:+.2e}"
            )


if __name__ == "__main__":
    main()
