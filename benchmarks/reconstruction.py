"""How far reconstructed centrelines are from the true ones, over rods rendered as datasets are.

python benchmarks/reconstruction.py [--rods 200] [--hard | --varying] [--out DIR] [--save FILE.npz]
[--views FILE.npz]

Draws rods from the thesis's ranges (seeded), renders them in Blender's interpreter, reconstructs
them from the pictures alone, and prints errors in per cent of the length. The error of a rod is the
mean distance of points at the same arc length. --views keeps the pictures, or takes them from there
if the file exists. --save writes `true` and `reconstructed` (rods, 150, 3) over L, with verdicts,
parameters and true strains: data for a model of reconstruction noise. --varying takes rods whose
natural curvature varies along their length.
"""

import argparse
import os
import platform
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

for _library in ("OMP", "OPENBLAS", "MKL"):  # threads that wait for one another count as CPU time
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import numpy as np  # noqa: E402
import numpy.typing as npt  # noqa: E402
from stickslip_schemas.spec.cameras import load_rig  # noqa: E402
from stickslip_sim_core import solve_general_rods, solve_rods  # noqa: E402
from stickslip_training.reconstruction.photographs import save_overlay  # noqa: E402
from stickslip_training.reconstruction.pipeline import Reconstruction, Verdict, reconstruct  # noqa: E402
from stickslip_training.reconstruction.starts import moving_cylinder, visual_hull  # noqa: E402
from stickslip_training.reconstruction.views import View, silhouette, to_linear  # noqa: E402

Floats = npt.NDArray[np.float64]

HERE = Path(__file__).parent
RIG = "rod-4"
RADIUS = 0.008  # [L], the renderer's default
RANGES = {"gamma": (100.0, 1300.0), "phi0": (0.2, 12.0), "phi1": (6.0, 20.0)}  # [thesis, 5.4.1]
# Where rods coil at their free end, twice over: most of the thesis's own few hard ones lie in this
# corner.
HARD_RANGES = {"gamma": (50.0, 200.0), "phi0": (0.2, 4.0), "phi1": (15.0, 30.0)}
DEVIATION = np.array(
    [2.0, 2.0, 3.0]
)  # of the first added cosine of twist, bend1 and bend2 [rad]; of the k-th, a k-th
WAVES = 3
BAD = 0.005  # [L]: a mean error above it, or a largest error above four times it, is a failure
DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True)
class Judged:
    """One rod: its reconstruction, and how far off it is [L]."""

    reconstruction: Reconstruction
    error: Floats
    """Distance at each point, (150,)."""
    seconds: float
    """CPU time."""

    @property
    def bad(self) -> bool:
        return bool(self.error.mean() > BAD or self.error.max() > 4.0 * BAD)


def draw_rods(count: int, seed: int, family: str = "thesis") -> dict[str, Floats]:
    """Return rods of a family that lie in all four frames.

    They are centrelines, strains, and the parameters that they are made from.
    """
    random, rig = np.random.Generator(np.random.PCG64(seed)), load_rig(RIG)
    ranges = HARD_RANGES if family == "hard" else RANGES
    parameters = {name: random.uniform(*bounds, 2 * count) for name, bounds in ranges.items()}
    if family == "varying":
        k, s = np.arange(1, WAVES + 1)[:, None], np.linspace(0.0, 1.0, 150)
        amplitudes = DEVIATION / k * random.normal(size=(2 * count, WAVES, 3))
        mean = np.stack([parameters["phi0"], 0 * parameters["phi0"], parameters["phi1"]], axis=1)
        natural = mean[:, None] + np.einsum("nki,ks->nsi", amplitudes, np.cos(np.pi * k * s))
        parameters = {"gamma": parameters["gamma"], "natural": natural}
        solution = solve_general_rods(natural, parameters["gamma"])
    else:
        solution = solve_rods(*parameters.values())
    lines, strains = solution.centerline, solution.curvature
    is_in_frame = [all(camera.overflow(line, RADIUS) <= 0.0 for camera in rig) for line in lines]
    rods = np.flatnonzero(np.array(is_in_frame) & solution.stable)[:count]
    return {
        "centerline": lines[rods],
        "strains": strains[rods],
        **{name: row[rods] for name, row in parameters.items()},
    }


def rendered(
    rods: int, seed: int, family: str, blender: Path, keep: Path | None
) -> dict[str, npt.NDArray[Any]]:
    """Return the rods with their `views`, rendered now unless `keep` has them."""
    if keep is not None and keep.exists():
        with np.load(keep) as file:
            return dict(file)
    with tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder) / "rods.npz"
        views = keep or Path(folder) / "views.npz"
        arrays: dict[str, Any] = {**draw_rods(rods, seed, family)}
        np.savez(drawn, **arrays)
        subprocess.run(
            [blender, HERE / "render_rod_set.py", drawn, views, "--rig", RIG], check=True
        )
        with np.load(views) as file:
            return dict(file)


def judge(views: npt.NDArray[np.uint8], true: Floats) -> Judged:
    start = time.process_time()
    reconstruction = reconstruct(views, load_rig(RIG))
    seconds = time.process_time() - start
    return Judged(reconstruction, np.linalg.norm(reconstruction.centerline - true, axis=1), seconds)


def thesis_error(pictures: npt.NDArray[np.uint8], true: Floats) -> float:
    """Return the mean error [L] of the centroid of a moving cylinder, the thesis's own way."""
    views = [
        View.of(camera, silhouette(to_linear(picture)), length=1.0, clamp=(0, 0, 0))
        for camera, picture in zip(load_rig(RIG), pictures, strict=True)
    ]
    line = moving_cylinder(visual_hull(views), RADIUS, DOWN)
    walked = np.linspace(0.0, 1.0, len(line))
    even = np.stack(
        [np.interp(np.linspace(0.0, 1.0, len(true)), walked, axis) for axis in line.T], axis=1
    )
    return float(np.linalg.norm(even - true, axis=1).mean())


def print_report(judged: list[Judged], thesis: list[float]) -> None:
    mean = 100.0 * np.array([item.error.mean() for item in judged])
    largest = 100.0 * np.array([item.error.max() for item in judged])
    print(
        f"{len(judged)} rods, {platform.machine()}, one process, one thread; errors in % of the "
        "length"
    )
    print(f"{'':24}{'median':>8}{'p95':>8}{'max':>8}")
    for name, values in (
        ("mean over the rod", mean),
        ("largest on the rod", largest),
        ("thesis: moving cylinder", 100.0 * np.array(thesis)),
    ):
        print(
            f"{name:24}{np.median(values):8.3f}{np.quantile(values, 0.95):8.3f}{values.max():8.3f}"
        )
    seconds = np.array([item.seconds for item in judged])
    print(f"CPU s a rod: median {np.median(seconds):.2f}, p95 {np.quantile(seconds, 0.95):.2f}")
    bad = np.array([item.bad for item in judged])
    flagged = np.array([item.reconstruction.verdict != Verdict.good for item in judged])
    print(f"failures (mean > {BAD:.1%} or largest > {4 * BAD:.1%}): {bad.sum()} of {len(bad)}")
    print(
        f"flagged: {flagged.sum()}; of the failures {(flagged & bad).sum()} of {bad.sum()}, "
        f"of the others {(flagged & ~bad).sum()} of {(~bad).sum()}"
    )
    for name in ("misfit", "unexplained", "unsupported", "residual_rms"):
        values = np.array([getattr(item.reconstruction, name) for item in judged])
        good = values[~bad]
        worst = f"{values[bad].min():.3f} to {values[bad].max():.3f}" if bad.any() else "-"
        print(
            f"  {name:13} others up to {good.max():.3f} (median {np.median(good):.3f}), failures "
            f"{worst}"
        )


def save_pictures(
    out: Path, rods: dict[str, npt.NDArray[Any]], judged: list[Judged], worst: int = 8
) -> None:
    """Write a histogram of errors, and overlays of the worst rods and of the middle one."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    out.mkdir(parents=True, exist_ok=True)
    mean = 100.0 * np.array([item.error.mean() for item in judged])
    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    axes.hist(mean, bins=np.geomspace(mean.min() * 0.9, mean.max() * 1.1, 50).tolist())
    axes.set(xscale="log", xlabel="mean distance from the true centreline [% L]", ylabel="rods")
    figure.savefig(out / "errors.png", dpi=150)
    order = np.argsort(mean)[::-1]
    for name, row in [(f"worst-{rank}", i) for rank, i in enumerate(order[:worst], 1)] + [
        ("middle", order[len(order) // 2])
    ]:
        save_overlay(
            out / f"{name}.png",
            list(rods["views"][row]),
            load_rig(RIG),
            judged[row].reconstruction.centerline,
            rods["centerline"][row],
        )


def save_data(path: Path, rods: dict[str, npt.NDArray[Any]], judged: list[Judged]) -> None:
    """Write true and reconstructed centrelines."""
    arrays: dict[str, Any] = {
        name: rods[name] for name in ("strains", "natural", *RANGES) if name in rods
    }
    np.savez_compressed(
        path,
        true=rods["centerline"],
        reconstructed=np.stack([item.reconstruction.centerline for item in judged]),
        deviation=np.stack([item.reconstruction.deviation for item in judged]),
        views_seen=np.stack([item.reconstruction.views_seen for item in judged]),
        verdict=np.array([item.reconstruction.verdict.value for item in judged]),
        misfit=np.array([item.reconstruction.misfit for item in judged]),
        **arrays,
    )


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--rods", type=int, default=200)
    arguments.add_argument("--seed", type=int, default=2024)
    kinds = arguments.add_mutually_exclusive_group()
    kinds.add_argument(
        "--hard", action="store_true", help="rods beyond the thesis's, to see failures flagged"
    )
    kinds.add_argument("--varying", action="store_true", help="rods of varying natural curvature")
    arguments.add_argument("--out", type=Path, help="folder for the histogram and overlays")
    arguments.add_argument("--save", type=Path, help="npz for true and reconstructed centrelines")
    arguments.add_argument("--views", type=Path, help="npz that keeps the rendered views")
    arguments.add_argument("--blender", type=Path, default=HERE.parent / ".venv-blender/bin/python")
    options = arguments.parse_args()

    family = "hard" if options.hard else "varying" if options.varying else "thesis"
    rods = rendered(options.rods, options.seed, family, options.blender, options.views)
    judged, thesis = [], []
    for views, true in zip(rods["views"], rods["centerline"], strict=True):
        judged.append(judge(views, true))
        thesis.append(thesis_error(views, true))
    print_report(judged, thesis)
    if options.out is not None:
        save_pictures(options.out, rods, judged)
    if options.save is not None:
        save_data(options.save, rods, judged)


if __name__ == "__main__":
    main()
