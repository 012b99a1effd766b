"""Natural shapes of rods from pictures, hung again: how far from the rods that were photographed.

python benchmarks/natural_from_pictures.py --reconstructed FILE.npz [--rods 50] [--model local-global.pt]

FILE.npz holds centrelines that were reconstructed from four rendered views, as `benchmarks/reconstruction.py --save`
writes them. The weight of each rod is known, as in the thesis. Three ways from a centreline to natural curvature:

* Eq. 5.1: curvature as the network of --model reads it, then the exact inverse: the thesis's way;
* three-parameter fit, and distributed fit: the hung rod is fitted to the centreline.

The natural rod is hung again by the solver; errors are distances at the same arc length from the true centreline, mean
and largest over the rod, and the relative RMS error of natural |kappa|.
"""

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

for _library in ("OMP", "OPENBLAS", "MKL"):  # threads that wait for one another count as CPU time
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import time  # noqa: E402

import numpy as np  # noqa: E402
import numpy.typing as npt  # noqa: E402
from stickslip_sim_core import (  # noqa: E402
    fit_natural_curvature,
    fit_parameters,
    natural_curvature,
    solve_general_rods,
)
from stickslip_training.rods.errors import bending, relative_rms_error  # noqa: E402

Floats = npt.NDArray[np.float64]

Way = Callable[[Floats, float, float], Floats]
"""From a centreline (150, 3), its gamma and its noise to natural curvature (150, 3)."""


def by_parameters(line: Floats, gamma: float, _noise: float) -> Floats:
    """Fit a uniform rod."""
    fit = fit_parameters(line, gamma=gamma)
    return np.tile([fit.phi0, 0.0, fit.phi1], (len(line), 1))


def by_distributed_fit(line: Floats, gamma: float, noise: float) -> Floats:
    """Fit natural curvature along the rod, as closely as the reconstruction says it is sure."""
    return fit_natural_curvature(line, gamma=gamma, noise=noise).natural_curvature


def by_network(model: Path) -> Way:
    """Read the strains with a network and invert Eq. 5.1."""
    import torch
    from stickslip_training.rods.local_global import load_local_global

    torch.set_num_threads(1)
    net = load_local_global(model)

    def way(line: Floats, gamma: float, _noise: float) -> Floats:
        with torch.inference_mode():
            strains = net(torch.from_numpy(line[None].astype(np.float32))).double().numpy()
        return np.asarray(natural_curvature(strains, None, [gamma]).curvature[0])

    return way


@dataclass(frozen=True)
class Rehung:
    """What came of some rods."""

    mean: Floats
    """Mean distance of the hung rod from the true one [L], (rods,); NaN where it does not hang."""
    largest: Floats
    natural: Floats
    """Relative RMS error of natural |kappa|, (rods,)."""
    seconds: float
    """CPU time a rod, the hanging included."""


def rehang(way: Way, seen: Floats, true: Floats, gamma: Floats, natural: Floats, noise: Floats) -> Rehung:
    """Find natural curvature from what is seen, hang it, and compare with the truth."""
    way(seen[0], gamma[0], noise[0])  # libraries are made once
    start = time.process_time()
    found = np.stack([way(*rod) for rod in zip(seen, gamma, noise, strict=True)])
    hung = solve_general_rods(found, gamma)
    seconds = (time.process_time() - start) / len(seen)
    distance = np.linalg.norm(hung.centerline - true, axis=2)
    error = relative_rms_error(bending(found), bending(natural))
    return Rehung(distance.mean(axis=1), distance.max(axis=1), error, seconds)


def report(name: str, result: Rehung) -> str:
    """Return a line of the Markdown table."""
    hangs = np.isfinite(result.mean)

    def told(values: Floats) -> str:
        of = np.sort(np.where(np.isfinite(values), values, np.inf))
        median, p95 = (of[min(round(q * (len(of) - 1)), len(of) - 1)] for q in (0.5, 0.95))
        return f"{median:.3%}, {p95:.3%}"

    failed = "" if hangs.all() else f" ({(~hangs).sum()} do not hang)"
    return (
        f"| {name}{failed} | {told(result.mean)} | {told(result.largest)} | {told(result.natural)} | "
        f"{result.seconds:.2f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reconstructed", type=Path, required=True)
    parser.add_argument("--rods", type=int, default=50)
    parser.add_argument("--model", type=Path, help="network of benchmarks/curvature_methods.py; none: no Eq. 5.1")
    options = parser.parse_args()
    with np.load(options.reconstructed) as file:
        some = {name: file[name][: options.rods] for name in file.files}
    if "natural" not in some:
        uniform = np.stack([some["phi0"], 0 * some["phi0"], some["phi1"]], axis=1)
        some["natural"] = np.broadcast_to(uniform[:, None], some["true"].shape)
    seen, true, gamma, natural = (some[name] for name in ("reconstructed", "true", "gamma", "natural"))
    noise = np.median(some["deviation"], axis=1) / np.sqrt(3.0)  # of a position, and so of a coordinate
    off = np.linalg.norm(seen - true, axis=2)
    print(f"{len(seen)} rods; each cell: median, p95. Reconstructed: mean {np.median(off.mean(axis=1)):.3%} of L")
    print("| way | hung again, mean distance / L | largest distance / L | natural curvature | CPU s |")
    print("|---|---|---|---|---|")
    ways: dict[str, Way] = {"three-parameter fit": by_parameters, "distributed fit": by_distributed_fit}
    if options.model:
        ways["network, then Eq. 5.1"] = by_network(options.model)
    for name, way in ways.items():
        print(report(name, rehang(way, seen, true, gamma, natural, noise)), flush=True)


if __name__ == "__main__":
    main()
