"""Curvature of a noisy centreline by every method we have, on rods of the thesis's family and beyond it.

python benchmarks/curvature_methods.py --models DIR [--reconstructed DIR] [--rods 200] [--figure FILE] [--table FILE]

Trains both networks unless DIR has them: ours, 9 CPU minutes, and that of the thesis's Table 5.1, 11. Then prints the
RMS relative error of |kappa| along each rod, median and 95 % quantile over the rods, and CPU time a rod, as a Markdown
table. White noise is per coordinate; 1 % is 0.01 L. --reconstructed names a folder with train.npz, thesis.npz and
varying.npz, which make the column of rods reconstructed from pictures:

    python benchmarks/reconstruction.py --rods 300 --seed 7 --save DIR/train.npz
    python benchmarks/reconstruction.py --rods 200 --seed 2024 --save DIR/thesis.npz
    python benchmarks/reconstruction.py --rods 100 --seed 2025 --varying --save DIR/varying.npz

The thesis splits 6215 rods into 5593 and 662, which are 6255: 622 adds up, and is a tenth. The rods are a random 6215
of its grid of 10,000, for what it sifted out is not known.
"""

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

for _library in ("OMP", "OPENBLAS", "MKL"):  # threads that wait for one another count as CPU time
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import numpy as np  # noqa: E402
import numpy.typing as npt  # noqa: E402
import torch  # noqa: E402
from rod_families import POINTS, RANGES, WAVES, Rods, bumpy_rods, cosines, family_rods, varying_rods  # noqa: E402
from stickslip_sim_core import fit_natural_curvature, fit_parameters, solve_general_rods, solve_rods  # noqa: E402
from stickslip_training.engine.fit import EpochReport  # noqa: E402
from stickslip_training.rods import curvature as table_5_1  # noqa: E402
from stickslip_training.rods import dataset  # noqa: E402
from stickslip_training.rods.baselines import (  # noqa: E402
    cubic_spline_curvature,
    finite_difference_curvature,
    quintic_spline_curvature,
)
from stickslip_training.rods.errors import bending, relative_rms_error  # noqa: E402
from stickslip_training.rods.local_global import (  # noqa: E402
    LocalGlobalTraining,
    load_local_global,
    save_local_global,
    train_local_global,
)
from stickslip_training.rods.noise import ReconstructionNoise, with_white_noise  # noqa: E402

Floats = npt.NDArray[np.float64]

POOL = 100_000
"""Training rods of each family; their noise is fresh at every step. Test rods come from other seeds."""
STEPS = 12_000
THESIS_RODS, THESIS_TRAINING = 6215, 5593
EPOCHS = 12


# --- training -------------------------------------------------------------------------------------------------


def train_ours(path: Path, reconstruction: ReconstructionNoise | None) -> None:
    """Train our network on rods of both families, far more than the thesis's."""
    random = np.random.default_rng(101)
    pools = [family_rods(POOL, random), varying_rods(POOL, random)]
    lines, strains = (
        np.concatenate([getattr(pool, name) for pool in pools]).astype(np.float32) for name in ("centerline", "strains")
    )
    del pools

    def tell(report: EpochReport) -> None:
        print(f"  step {report.step}: loss {report.train_loss:.4f}, {report.seconds:.0f} s", flush=True)

    mixed = np.random.default_rng(0).permutation(len(lines))  # the components come from every so many of them
    settings = LocalGlobalTraining(steps=STEPS)
    net = train_local_global(
        lines[mixed], strains[mixed], settings, reconstruction=reconstruction, on_epoch=tell, every=1000
    )
    save_local_global(path, net, settings)


def train_thesis(path: Path) -> None:
    """Train the network of Table 5.1 as the thesis does: 5593 rods of its grid, one level of noise, Adadelta."""
    axes = [np.linspace(*bounds, number) for bounds, number in zip(RANGES.values(), (100, 10, 10), strict=True)]
    grid = np.stack([values.ravel() for values in np.meshgrid(*axes, indexing="ij")])
    chosen = np.random.default_rng(102).permutation(grid.shape[1])[:THESIS_RODS]
    solution = solve_rods(*grid[:, chosen])
    rods = dataset.Rods(chosen, solution.centerline.astype(np.float32), solution.curvature.astype(np.float32))
    config = table_5_1.CurvatureTraining(
        dataset="the thesis's grid", out=path.parent / "table-5.1", epochs=EPOCHS, threads=1
    )
    net = table_5_1.train_on_rods(config, rods[:THESIS_TRAINING], rods[THESIS_TRAINING:])
    torch.save({"net": net.state_dict()}, path)


# --- methods --------------------------------------------------------------------------------------------------


def three_parameter_fit(line: Floats) -> Floats:
    return bending(fit_parameters(line).solution.curvature[0])


def distributed_fit(line: Floats) -> Floats:
    return bending(fit_natural_curvature(line).solution.curvature[0])


def told_fit(deviation: Floats) -> "Method":
    """Return the distributed fit that is told the noise of each rod."""

    def method(lines: npt.NDArray[np.float32]) -> Floats:
        fits = [
            fit_natural_curvature(line, noise=float(noise))
            for line, noise in zip(lines.astype(np.float64), deviation, strict=False)
        ]
        return np.stack([bending(fit.solution.curvature[0]) for fit in fits])

    return method


Method = Callable[[npt.NDArray[np.float32]], Floats]
"""From centrelines (rods, 150, 3) to |kappa| (rods, 150); NaN for a rod without an answer."""


def rod_by_rod(fit: Callable[[Floats], Floats]) -> Method:
    """Return a method that fits one rod after the other."""

    def method(lines: npt.NDArray[np.float32]) -> Floats:
        answers = np.full(lines.shape[:2], np.nan)
        for row, line in enumerate(lines.astype(np.float64)):
            try:
                answers[row] = fit(line)
            except RuntimeError:  # no rod nearby hangs in a stable equilibrium
                continue
        return answers

    return method


def network(net: torch.nn.Module) -> Method:
    """Return a trained network as a method."""

    def method(lines: npt.NDArray[np.float32]) -> Floats:
        with torch.inference_mode():
            return bending(net(torch.from_numpy(lines)).numpy())

    return method


def all_methods(models: Path) -> dict[str, Method]:
    """Return the methods of the table by name."""
    return {
        "finite differences": finite_difference_curvature,
        "cubic smoothing spline, cross-validated": cubic_spline_curvature,
        "quintic smoothing spline, cross-validated": quintic_spline_curvature,
        "three-parameter fit": rod_by_rod(three_parameter_fit),
        "distributed fit, cross-validated": rod_by_rod(distributed_fit),
        "network of Table 5.1": network(table_5_1.load_model(models / THESIS_NAME)),
        OURS: network(load_local_global(models / OUR_NAME)),
    }


OURS, TOLD, BOUND = "local-global network", "distributed fit, noise given", "bound: the family known"
ORDER = (
    "finite differences",
    "cubic smoothing spline, cross-validated",
    "quintic smoothing spline, cross-validated",
    "three-parameter fit",
    "distributed fit, cross-validated",
    TOLD,
    "network of Table 5.1",
    OURS,
    BOUND,
)
"""Of the methods in the table."""


def posterior_errors(rods: Rods, noise: float, varies: bool) -> Floats:
    """Return errors of |kappa| that are left to one who knows the family and the noise, DRAWS of each rod.

    The posterior of the family's parameters (gamma, phi0, phi1, and where it varies nine amplitudes) is taken to be
    normal about the true rod, their prior normal with their variances, and |kappa| linear in them; errors are drawn
    from it.
    """
    bounds = np.array(list(RANGES.values()))
    deviations = (bounds[:, 1] - bounds[:, 0]) / np.sqrt(12.0)
    constant = [np.tile(row, (POINTS, 1)) for row in ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])]
    directions = [
        (d if i == 0 else 0.0, d * field) for i, (d, field) in enumerate(zip(deviations, constant, strict=True))
    ]
    if varies:
        directions += [(0.0, field) for field in cosines(np.eye(3 * WAVES).reshape(-1, WAVES, 3))]
    step = 1e-4
    lines, bends = [], []
    for weight, field in directions:
        ends = [
            solve_general_rods(
                rods.natural + sign * step * field, rods.gamma + sign * step * weight, start_curvature=rods.strains
            )
            for sign in (1.0, -1.0)
        ]
        lines.append((ends[0].centerline - ends[1].centerline).reshape(len(rods), -1) / (2.0 * step))
        bends.append((bending(ends[0].curvature) - bending(ends[1].curvature)) / (2.0 * step))
    J, B = np.stack(lines, axis=2), np.stack(bends, axis=2)
    covariance = np.linalg.inv(J.swapaxes(1, 2) @ J / noise**2 + np.eye(len(directions)))
    normal = np.random.default_rng(204).standard_normal((len(rods), len(directions), DRAWS))
    errors = B @ np.linalg.cholesky(covariance) @ normal
    size = np.square(bending(rods.strains)).mean(axis=1)[:, None]
    return np.asarray(np.sqrt(np.square(errors).mean(axis=1) / size).ravel())


DRAWS = 20


# --- the table ------------------------------------------------------------------------------------------------

NOISES = (0.001, 0.005, 0.01)


@dataclass(frozen=True)
class Case:
    """Rods and what is seen of them."""

    family: str
    noise: str
    centerline: npt.NDArray[np.float32]
    truth: Floats
    """|kappa| (rods, 150)."""
    deviation: Floats | None
    """Standard deviation of a coordinate [L], as the reconstruction gives it, (rods,); None: the noise is white."""
    bound: Floats | None
    """Errors that remain to one who knows the family; None where the noise is not white."""


def white_cases(count: int) -> list[Case]:
    """Return test rods of all families under white noise."""
    cases = []
    draws = (("thesis", family_rods, NOISES), ("varying", varying_rods, NOISES), ("bumps", bumpy_rods, NOISES[1:2]))
    for seed, (family, draw, noises) in enumerate(draws):
        rods = draw(count, np.random.default_rng(201 + seed))
        for noise in noises:
            cases.append(
                Case(
                    family,
                    f"{100 * noise:g} %",
                    with_white_noise(rods.centerline, noise, (203, seed, round(1e5 * noise))),
                    bending(rods.strains),
                    None,
                    None if family == "bumps" else posterior_errors(rods, noise, family == "varying"),
                )
            )
    return cases


def reconstructed_cases(folder: Path, count: int) -> list[Case]:
    """Return rods whose centrelines were reconstructed from pictures."""
    cases = []
    for family in ("thesis", "varying"):
        with np.load(folder / f"{family}.npz") as file:
            lines = file["reconstructed"][:count].astype(np.float32)
            deviation = np.median(file["deviation"][:count], axis=1) / np.sqrt(3.0)
            cases.append(Case(family, "pictures", lines, bending(file["strains"][:count]), deviation, None))
    return cases


@dataclass(frozen=True)
class Result:
    """How well a method does in a case."""

    method: str
    case: Case
    errors: Floats
    seconds: float
    """CPU time a rod."""

    @property
    def failed(self) -> int:
        return int((~np.isfinite(self.errors)).sum())

    @property
    def median(self) -> float:
        return float(np.median(np.where(np.isfinite(self.errors), self.errors, np.inf)))

    @property
    def text(self) -> str:
        """Median and 95 % quantile; rods without an answer are infinitely wrong."""
        errors = np.sort(np.where(np.isfinite(self.errors), self.errors, np.inf))
        quantiles = [errors[min(round(q * (len(errors) - 1)), len(errors) - 1)] for q in (0.5, 0.95)]
        return ", ".join(percent(value) for value in quantiles) + (f" ({self.failed} fail)" if self.failed else "")


def percent(share: float) -> str:
    """Two digits that count."""
    if not np.isfinite(share):
        return "-"
    value = 100.0 * share
    return f"{value:,.0f} %" if value >= 9.95 else f"{value:.2g} %"


def told_time(milliseconds: float) -> str:
    return f"{milliseconds:.0f}" if milliseconds >= 9.95 else f"{milliseconds:.2g}"


def measure(method: str, run: Method, case: Case) -> Result:
    run(case.centerline[:1])  # libraries and bases are made once, whatever the number of rods
    start = time.process_time()
    estimate = run(case.centerline)
    seconds = (time.process_time() - start) / len(case.truth)
    return Result(method, case, relative_rms_error(estimate, case.truth), seconds)


def markdown(results: list[Result], family: str) -> str:
    """Return the table of one family: methods by noises."""
    mine = [result for result in results if result.case.family == family]
    noises = list(dict.fromkeys(result.case.noise for result in mine))
    lines = [f"| method | {' | '.join(noises)} | CPU ms |", "|---" * (len(noises) + 2) + "|"]
    for method in dict.fromkeys(result.method for result in mine):
        cells = {result.case.noise: result for result in mine if result.method == method}
        texts = [cells[noise].text if noise in cells else "" for noise in noises]
        milliseconds = 1e3 * float(np.median([result.seconds for result in cells.values()]))
        lines.append(f"| {method} | {' | '.join(texts)} | {'' if method == BOUND else told_time(milliseconds)} |")
    return "\n".join(lines)


def draw_figure(path: Path, results: list[Result]) -> None:
    """Draw the median error of every method over the noise, one panel for each family."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 2, figsize=(11, 4.8), sharey=True, layout="constrained")
    for panel, family in zip(panels, ("thesis", "varying"), strict=True):
        mine = [result for result in results if result.case.family == family]
        noises = list(dict.fromkeys(result.case.noise for result in mine))
        for number, method in enumerate(dict.fromkeys(result.method for result in mine)):
            if method.startswith("finite"):
                continue
            of = {result.case.noise: 100 * result.median for result in mine if result.method == method}
            places: list[float] = [noises.index(noise) for noise in of]
            values = list(of.values())
            if "pictures" in of:  # a kind of noise, and no larger one: the line has a gap before it
                places.insert(-1, np.nan)
                values.insert(-1, np.nan)
            if method == BOUND:
                panel.plot(places, values, color="0.5", ls=":", label=method)
            else:
                color, width = ("k", 2.5) if method == OURS else (f"C{number}", 1.5)
                panel.plot(places, values, color=color, lw=width, marker="o", label=method)
        panel.set_xticks(range(len(noises)), noises)
        panel.set(yscale="log", xlabel="noise of the centreline", title=f"{TITLES[family]}, {len(mine[0].errors)} rods")
        panel.yaxis.set_major_formatter("{x:g}")
        panel.grid(alpha=0.3, which="both")
    panels[0].set_ylabel(r"error of $|\kappa|$, median [%]")
    panels[1].legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(1.0, 0.0))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


TITLES = {
    "thesis": "Rods of the thesis's family",
    "varying": "Rods that vary along their length",
    "bumps": "Rods of a kind that the network has not seen",
}
THESIS_NAME, OUR_NAME = "table-5.1.pt", "local-global.pt"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, required=True, help="folder of the trained networks")
    parser.add_argument("--reconstructed", type=Path, help="folder of rods reconstructed from pictures")
    parser.add_argument("--rods", type=int, default=200, help="test rods of each family")
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--table", type=Path, help="also write the tables, as Markdown")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.models.mkdir(parents=True, exist_ok=True)
    if not (options.models / OUR_NAME).exists():
        noise = ReconstructionNoise.load(options.reconstructed / "train.npz") if options.reconstructed else None
        train_ours(options.models / OUR_NAME, noise)
    if not (options.models / THESIS_NAME).exists():
        train_thesis(options.models / THESIS_NAME)
    cases = white_cases(options.rods)
    if options.reconstructed:
        cases += reconstructed_cases(options.reconstructed, options.rods)
    results = [Result(BOUND, case, case.bound, 0.0) for case in cases if case.bound is not None]
    for name, method in all_methods(options.models).items():
        results = [*results, *(measure(name, method, case) for case in cases)]
        print(f"{name}: done", flush=True)
    for case in cases:
        if case.deviation is not None:  # cross-validation takes noise for white
            results.append(measure(TOLD, told_fit(case.deviation), case))
    results.sort(key=lambda result: ORDER.index(result.method))
    text = "\n\n".join(f"{TITLES[family]}:\n\n{markdown(results, family)}" for family in TITLES)
    print(text)
    if options.table:
        options.table.write_text(text + "\n")
    if options.figure:
        draw_figure(options.figure, results)


if __name__ == "__main__":
    main()
