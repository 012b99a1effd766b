"""Time and accuracy of the thesis's grid of 10,000 hanging rods, on one thread.

python benchmarks/rods.py [--repeats 5]

Prints CPU seconds (all of the process: solving, sampling 150 points, page faults of the output)
and, for the same settings, errors against a solve with 1,024 elements on every seventh rod.
"""

import argparse
import os
import platform
import statistics
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from stickslip_sim_core import RodSolution, build_info, solve_rods

Floats = NDArray[np.float64]

# Two settings: enough for 1e-3 of the length, and the default.
SETTINGS = {"1e-3": 48, "default": 128}
REFINED = 1024
SUBSAMPLE = 7


def thesis_grid() -> Floats:
    """Rows gamma, phi0, phi1 of the grid of thesis section 5.4, shape (3, 10000)."""
    axes = (np.linspace(100, 1300, 100), np.linspace(0.2, 12, 10), np.linspace(6, 20, 10))
    return np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")])


def cpu_seconds(rods: Floats, elements: int) -> tuple[float, RodSolution]:
    """CPU time of one solve of all rods."""
    start = time.process_time()
    solution = solve_rods(*rods, elements=elements)
    return time.process_time() - start, solution


def cpu_model() -> str:
    """Name of the processor, as the kernel tells it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def quantiles(errors: Floats) -> str:
    return "median {:.1e}  p95 {:.1e}  max {:.1e}".format(*np.quantile(errors, [0.5, 0.95, 1.0]))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--repeats", type=int, default=5, help="timed solves per setting; the median is printed"
    )
    repeats = parser.parse_args().repeats

    build = build_info()
    print(
        f"stickslip-sim-core {build.version}  build {build.build_hash[:12]}  {build.compiler}  isa "
        f"{build.isa}"
    )
    print(
        f"rod kernel {build.rod_kernel}  numpy {np.__version__}  python {platform.python_version()}"
    )
    print(f"cpu {cpu_model()}  {os.cpu_count()} cores  load {os.getloadavg()[0]:.1f}")

    rods = thesis_grid()
    reference = solve_rods(*rods[:, ::SUBSAMPLE], elements=REFINED)
    solve_rods(*rods[:, ::100])  # warm up
    for name, elements in SETTINGS.items():
        # One solution at a time: each is 180 MB.
        times = [cpu_seconds(rods, elements)[0] for _ in range(repeats)]
        solution = cpu_seconds(rods, elements)[1]
        nodes = slice(None, None, SUBSAMPLE)
        distance = np.linalg.norm(solution.centerline[nodes] - reference.centerline, axis=2).max(
            axis=1
        )
        scale = np.abs(reference.curvature).max(axis=(1, 2))
        curvature = np.abs(solution.curvature[nodes] - reference.curvature).max(axis=(1, 2)) / scale
        turn = np.linalg.norm(solution.frame[nodes] - reference.frame, axis=(2, 3)).max(
            axis=1
        ) / np.sqrt(2)
        print(
            f"\n{name}: {elements} elements, {rods.shape[1]} rods x {solution.centerline.shape[1]} "
            "points"
        )
        print(
            f"  CPU s, median of {repeats}: {statistics.median(times):.3f}  (min {min(times):.3f})"
        )
        print(f"  converged {solution.converged.mean():.2%}  stable {solution.stable.mean():.2%}")
        print(
            f"  sweeps per rod: mean {solution.iterations.mean():.1f}  max "
            f"{solution.iterations.max()}"
        )
        print(f"  centreline error / L:      {quantiles(distance)}")
        print(f"  curvature error / max|k|:  {quantiles(curvature)}")
        print(f"  frame error, rad:          {quantiles(turn)}")


if __name__ == "__main__":
    main()
