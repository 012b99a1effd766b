"""Continuous numbers of a fabric, estimated as friction is: a histogram for each, over its decimal logarithm.

With rho the mass per area, B the mean of the plate rigidities along warp and weft, and g gravity, a cloth bends under
its weight over the length

    L_gb = (B / (rho g))^(1/3)

Inextensible cloth on a plane with dry friction moves the same for all rho and B of one L_gb and mu: forces are all in
proportion to the weight. So a clip shows L_gb. It shows rho and B only as far as the cloth stretches, and as far
as weights differ between fabrics.
"""

from dataclasses import dataclass

import numpy as np

from stickslip_training.arrays import Array, Floats, Integers
from stickslip_training.cloth.evaluation import Measure, measure
from stickslip_training.cloth.posterior import SHARE, Bins, estimates

GRAVITY = 9.81
"""[m/s^2]"""


@dataclass(frozen=True)
class Quantity:
    """A number of a fabric."""

    name: str
    unit: str
    bins: Bins
    """Of its decimal logarithm."""


FABRIC = (
    Quantity("areal_density", "kg/m^2", Bins(-1.25, -0.2, 48)),
    Quantity("bending_rigidity", "N m", Bins(-6.0, -3.6, 48)),
    Quantity("bending_length", "m", Bins(-2.2, -1.2, 48)),
)
"""In the order of the columns of `Runs.fabric` and `Clips.fabric`: our fabrics, and factors from 0.4 to 2.5 of them."""


def fabric_numbers(density: Array, rigidity: Array) -> Floats:
    """Return log10 of `FABRIC`, (n, 3), of areal densities (n,) and rigidities (n, 3); NaN where one is NaN."""
    rho, along = np.asarray(density, dtype=np.float64), np.asarray(rigidity, dtype=np.float64)[:, :2].mean(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):  # what is no fabric gets no number
        numbers = np.log10(np.stack([rho, along, np.cbrt(along / (rho * GRAVITY))], axis=1))
    return np.where(np.isfinite(numbers), numbers, np.nan)


def numbers_of_runs(about: list[dict[str, object]]) -> Floats:
    """Return log10 of `FABRIC` of runs, (runs, 3), as `cloth_runs.py` writes them; NaN where they are missing."""
    unknown = float("nan")
    density = [run.get("areal_density", unknown) for run in about]
    rigidity = [run.get("bending_rigidity", [unknown] * 3) for run in about]
    return fabric_numbers(np.array(density), np.array(rigidity))


@dataclass(frozen=True, kw_only=True)
class FabricErrors:
    """Of one quantity, over some clips."""

    clips: int
    simulations: int
    error: Measure
    """Mean of |ln(median / truth)|: about the relative error."""
    guess: Measure
    """The same of one number for each material, the median of its clips: who only knows the material errs so."""
    coverage: Measure
    """Share of the clips whose 80 % interval holds the truth."""
    width: Measure
    """Mean of ln(high / low)."""


def score_fabric(
    quantities: tuple[Quantity, ...], histograms: dict[str, Floats], truth: Floats, material: Integers, run: Integers
) -> dict[str, FabricErrors]:
    """Compare histograms (clips, bins) of quantities with log10 of the truth, (clips, 3), clip by clip."""
    scale, found = float(np.log(10.0)), {}
    for quantity in quantities:
        estimated = estimates(histograms[quantity.name], quantity.bins, SHARE)
        true = truth[:, FABRIC.index(quantity)]
        guess = np.array([np.median(true[material == code]) for code in material])
        found[quantity.name] = FabricErrors(
            clips=len(true),
            simulations=len(np.unique(run)),
            error=measure(scale * np.abs(estimated.median - true), run),
            guess=measure(scale * np.abs(guess - true), run),
            coverage=measure(((estimated.low <= true) & (true <= estimated.high)).astype(float), run),
            width=measure(scale * (estimated.high - estimated.low), run),
        )
    return found


def fabric_intervals(
    quantities: tuple[Quantity, ...], histograms: dict[str, Floats]
) -> dict[str, list[dict[str, float]]]:
    """Return median and shortest 80 % interval of each quantity, in its unit, for every clip."""
    found = {}
    for quantity in quantities:
        estimated = estimates(histograms[quantity.name], quantity.bins, SHARE)
        found[quantity.name] = [
            {"median": _rounded(median), "low": _rounded(low), "high": _rounded(high)}
            for median, low, high in zip(estimated.median, estimated.low, estimated.high, strict=True)
        ]
    return found


def _rounded(logarithm: float) -> float:
    return float(f"{10.0**logarithm:.4g}")
