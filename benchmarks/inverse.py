"""From a hanging rod back to its natural curvature.

The cases are an exact centreline, how ill-conditioned the problem is, and a noisy centreline.

OPENBLAS_NUM_THREADS=1 python benchmarks/inverse.py [--rods 50] [--figure docs/figures/inverse.png]

Prints quantiles over random rods of the thesis's ranges, of natural curvature as root mean squares
along the rod. Noise is white, per coordinate; 1 % is 0.01 L. Out-of-family rods add to each
component of the natural curvature 3 cosines of standard deviation (2, 2, 3)/k, k = 1 ... 3.
"""

import argparse
import os
import platform
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from stickslip_sim_core import (
    RodSolution,
    build_info,
    fit_natural_curvature,
    fit_parameters,
    natural_curvature,
    solve_general_rods,
    solve_rods,
)

Floats = NDArray[np.float64]

POINTS = 150
S = np.linspace(0.0, 1.0, POINTS)[:, None]


def rms(field: Floats) -> Floats:
    """Root mean square along the rod of |field|, shape (..., P, 3) to (...)."""
    return np.asarray(np.sqrt((field**2).sum(axis=-1).mean(axis=-1)))


def bending_error(kappa: Floats, truth: Floats) -> float:
    """Relative root mean square error of |kappa|, the curvature of the centreline."""
    estimate, exact = (np.hypot(k[..., 1], k[..., 2]) for k in (kappa, truth))
    return float(np.sqrt(((estimate - exact) ** 2).mean() / (exact**2).mean()))


def quantiles(errors: Floats | list[float]) -> str:
    """Of the finite ones; the others, rods whose fit does not hang, are counted."""
    finite = np.asarray(errors)[np.isfinite(errors)]
    failed = len(errors) - len(finite)
    text = "median {:8.2g}  p95 {:8.2g}  max {:8.2g}".format(*np.quantile(finite, [0.5, 0.95, 1.0]))
    return text + (f"  ({failed} without an equilibrium)" if failed else "")


def exact_inverse(rng: np.random.Generator) -> None:
    print(
        "\nexact inverse, curvature from solve_rods at 150 points: relative error of natural "
        "curvature"
    )
    n = 200
    for gamma in (100.0, 500.0, 1300.0):
        phi0, phi1 = rng.uniform([0.2, 6], [12, 20], (n, 2)).T
        weight = np.full(n, gamma)
        natural = np.stack([phi0, 0 * phi0, phi1], axis=1)[:, None] * np.ones((1, POINTS, 1))
        rods = solve_rods(weight, phi0, phi1)
        with_frames = natural_curvature(rods.curvature, rods.frame, weight)
        alone = natural_curvature(rods.curvature, None, weight)
        for name, result in (("curvature and frames", with_frames), ("curvature alone", alone)):
            print(
                f"  gamma {gamma:6.0f}  {name:21s} "
                f"{quantiles(rms(result.curvature - natural) / rms(natural))}"
            )
        modes = np.polynomial.legendre.legvander(2 * S[:, 0] - 1, 4) * np.sqrt(2 * np.arange(5) + 1)
        error = np.einsum("pb,nbi->npi", modes, rng.normal(size=(n, 5, 3)) / np.sqrt(15))
        error *= 0.01 * rms(rods.curvature)[:, None, None]
        perturbed = natural_curvature(rods.curvature + error, None, weight).curvature
        measured = rms(perturbed - natural) / rms(natural) / 0.01
        predicted, worst = alone.amplification, alone.amplification_max
        print(
            f"  gamma {gamma:6.0f}  amplification of a smooth 1 % error: predicted "
            f"{np.sqrt((predicted**2).mean()):.1f}"
            f" (median {np.median(predicted):.1f}, worst mode {np.median(worst):.1f}),"
            f" measured {np.sqrt((measured**2).mean()):.1f} (median {np.median(measured):.1f})"
        )


def three_parameters(rods: RodSolution, rng: np.random.Generator) -> None:
    n = len(rods.energy)
    print(f"\nthree-parameter fit, {n} rods: relative error of |kappa|")
    fit_parameters(rods.centerline[0])  # hangs the library
    for noise in (0.001, 0.005, 0.01):
        start = time.process_time()
        fits = [fit_parameters(r + noise * rng.normal(size=r.shape)) for r in rods.centerline]
        seconds = (time.process_time() - start) / n
        errors = [
            bending_error(f.solution.curvature[0], k)
            for f, k in zip(fits, rods.curvature, strict=True)
        ]
        print(f"  noise {noise:5.1%}  {quantiles(errors)}  CPU s per fit {seconds:.3f}")


def distributed(
    name: str, natural: Floats, gamma: Floats, known: bool, rng: np.random.Generator
) -> None:
    rods = solve_general_rods(natural, gamma)
    noisy = rods.centerline + 0.005 * rng.normal(size=rods.centerline.shape)
    weights: list[float] | list[None] = list(gamma) if known else [None] * len(gamma)
    start = time.process_time()
    fits = [fit_natural_curvature(r, gamma=w) for r, w in zip(noisy, weights, strict=True)]
    seconds = (time.process_time() - start) / len(gamma)
    uniform = [fit_parameters(r, gamma=w) for r, w in zip(noisy, weights, strict=True)]
    print(f"\n{name}, gamma {'known' if known else 'fitted'}, noise 0.5 %, {len(gamma)} rods")
    deformed = [
        bending_error(f.solution.curvature[0], k) for f, k in zip(fits, rods.curvature, strict=True)
    ]
    baseline = [
        bending_error(f.solution.curvature[0], k)
        for f, k in zip(uniform, rods.curvature, strict=True)
    ]
    rest = [bending_error(f.natural_curvature, k) for f, k in zip(fits, natural, strict=True)]
    pairs = list(zip(fits, rods.centerline, strict=True))
    distance = [float(np.linalg.norm(f.solution.centerline[0] - r, axis=1).max()) for f, r in pairs]
    print(f"  |kappa| hanging, distributed fit       {quantiles(deformed)}")
    print(f"  |kappa| hanging, three-parameter fit   {quantiles(baseline)}")
    print(f"  |kappa_bar|, distributed fit           {quantiles(rest)}")
    print(f"  re-hung centreline to truth, largest/L {quantiles(distance)}")
    print(
        f"  degrees of freedom, median {np.median([f.degrees_of_freedom for f in fits]):.1f}",
        end="",
    )
    print(
        f"  noise found, median {np.median([f.noise for f in fits]):.5f}  CPU s per fit "
        f"{seconds:.2f}"
    )


def figure(path: Path, natural: Floats, gamma: float) -> None:
    """Draw one out-of-family rod: noisy centreline, hung fits, curvature and natural curvature."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rod = solve_general_rods(natural[None], [gamma])
    noisy = rod.centerline[0] + 0.005 * np.random.default_rng(5).normal(size=(POINTS, 3))
    fit, uniform = fit_natural_curvature(noisy, gamma=gamma), fit_parameters(noisy, gamma=gamma)
    flat = np.tile([uniform.phi0, 0.0, uniform.phi1], (POINTS, 1))
    fig, axes = plt.subplots(
        1, 3, figsize=(12.5, 4.2), gridspec_kw={"width_ratios": [1, 1.6, 1.6]}, layout="constrained"
    )
    bend = [
        np.hypot(k[:, 1], k[:, 2])
        for k in (rod.curvature[0], fit.solution.curvature[0], uniform.solution.curvature[0])
    ]
    rest = [np.hypot(k[:, 1], k[:, 2]) for k in (natural, fit.natural_curvature, flat)]
    axes[0].plot(noisy[:, 0], noisy[:, 2], ".", ms=2.5, color="0.6")
    for solution, style in ((fit.solution, "C0-"), (uniform.solution, "C1--")):
        axes[0].plot(solution.centerline[0, :, 0], solution.centerline[0, :, 2], style)
    axes[0].set(
        xlabel="x / L",
        ylabel="z / L",
        aspect="equal",
        title=f"$\\gamma$ = {gamma:.0f}, dots measured",
    )
    axes[0].locator_params(axis="x", nbins=3)
    axes[0].margins(x=0.3)
    for ax, curves, title in (
        (axes[1], bend, r"$|\kappa|$ hanging"),
        (axes[2], rest, r"$|\bar\kappa|$ natural"),
    ):
        ax.plot(S[:, 0], curves[0], "k", lw=3, alpha=0.35, label="truth")
        ax.plot(S[:, 0], curves[1], "C0", label="distributed fit")
        ax.plot(S[:, 0], curves[2], "C1--", label="three-parameter fit")
        ax.set(xlabel="s / L", title=f"{title}  [1/L]", ylim=(0, None))
        ax.grid(alpha=0.3)
    axes[2].legend(loc="lower left")
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rods", type=int, default=50, help="rods per fit experiment")
    parser.add_argument("--figure", type=Path, help="also draw one fit, to this PNG")
    arguments = parser.parse_args()
    n = arguments.rods

    build = build_info()
    print(
        f"stickslip-sim-core {build.version}  build {build.build_hash[:12]}  {build.compiler}  isa "
        f"{build.isa}"
    )
    threads = os.environ.get("OPENBLAS_NUM_THREADS", "all")
    print(f"numpy {np.__version__}  python {platform.python_version()}  BLAS threads {threads}")
    exact_inverse(np.random.default_rng(1))

    rng = np.random.default_rng(2)
    gamma, phi0, phi1 = rng.uniform([100, 0.2, 6], [1300, 12, 20], (n, 3)).T
    inside = np.stack([phi0, 0 * phi0, phi1], axis=1)[:, None] * np.ones((1, POINTS, 1))
    outside = inside.copy()
    for k in (1, 2, 3):
        outside += (
            rng.normal(size=(n, 1, 3)) * np.array([2.0, 2.0, 3.0]) / k * np.cos(np.pi * k * S)
        )
    if arguments.figure:
        lightest = int(np.argmin(gamma))
        figure(arguments.figure, outside[lightest], float(gamma[lightest]))
    three_parameters(solve_rods(gamma, phi0, phi1), rng)
    for known in (True, False):
        distributed("in family", inside, gamma, known, rng)
        distributed("out of family", outside, gamma, known, rng)


if __name__ == "__main__":
    main()
