"""Scores of estimates of friction, with intervals over simulations.

They are fractions as in the thesis, calibration, and errors in bands of mu.

Clips of one simulation are not independent. So intervals are over simulations, which are drawn
again with replacement [bootstrap] together with all their clips.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip_training.arrays import Floats, Integers
from stickslip_training.cloth.posterior import SHARE, Estimates, Posterior, estimates

BANDS = ((0.0, 0.4), (0.4, 0.8), (0.8, 1.2), (1.2, 1.6))
"""Of mu: below 0.3 or so there are two branches, and above 1 a difference of 0.1 moves edges by
less than half a pixel."""

PRIOR = (0.8, 0.16, 1.44)
"""Median, low and high of who knows only that mu is from 0 to 1.6."""

_DRAWS = 1000
# 8 of the 15 neighbours in linspace(0, 1.5, 16) are less than 0.1 apart in float64, and 7 are not
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Measure:
    """A number and its 90 % interval over simulations."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Of mu, over some clips."""

    clips: int
    simulations: int
    mae: Measure
    """Mean absolute error of the median."""
    within_01: Measure
    """Share of the clips with an error below 0.1."""
    within_02: Measure
    coverage: Measure
    """Share of the clips whose 80 % interval holds the truth."""
    interval: Measure
    """Mean interval score [Gneiting and Raftery 2007, Eq. 43]: the width of the 80 % interval, and
    10 times what the truth is beyond it. Who says wide intervals, or wrong ones, has a large score.
    """


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Scores of the answers to some clips."""

    blind: Errors
    """Material not known."""
    top_1: Measure
    """Share of the clips whose likeliest material is the true one."""
    top_2: Measure
    bands: dict[str, Errors]


@dataclass(frozen=True, eq=False, kw_only=True)
class Truth:
    """True values of some clips, (clips,) each."""

    material: Integers
    mu: Floats
    run: Integers
    """Number of the simulation: errors count simulations and not clips."""


def _scores(found: Estimates, material: Floats, truth: Truth) -> Scores:
    """Return scores of estimates of mu and of probabilities of materials (clips, materials)."""
    of_true = material[np.arange(len(material)), truth.material][:, None]
    rank = (material >= of_true).sum(axis=1) - 1
    masks = {
        f"{a:g} to {b:g}": (truth.mu >= a) & (truth.mu < b + (b == BANDS[-1][1])) for a, b in BANDS
    }
    return Scores(
        blind=errors(found, truth.mu, truth.run),
        top_1=measure((rank < 1).astype(float), truth.run),
        top_2=measure((rank < 2).astype(float), truth.run),
        bands={
            name: errors(
                Estimates(found.median[one], found.low[one], found.high[one]),
                truth.mu[one],
                truth.run[one],
            )
            for name, one in masks.items()
            if one.any()
        },
    )


def errors(found: Estimates, mu: Floats, run: Integers) -> Errors:
    """Return the errors of estimates of `mu`, (clips,), of the simulations `run`, (clips,)."""
    off = np.abs(found.median - mu)
    inside = (found.low - _ROUNDING <= mu) & (mu <= found.high + _ROUNDING)
    beyond = np.maximum(found.low - mu, 0.0) + np.maximum(mu - found.high, 0.0)
    return Errors(
        clips=len(mu),
        simulations=len(np.unique(run)),
        mae=measure(off, run),
        within_01=measure((off < 0.1 - _ROUNDING).astype(float), run),
        within_02=measure((off < 0.2 - _ROUNDING).astype(float), run),
        coverage=measure(inside.astype(float), run),
        interval=measure(found.high - found.low + 2 / (1 - SHARE) * beyond, run),
    )


def measure(values: Floats, run: Integers) -> Measure:
    """Return the mean of `values` (clips,), and its 5 % and 95 % quantiles.

    The quantiles are over simulations that are drawn with replacement.
    """
    _, number = np.unique(run, return_inverse=True)
    totals = np.bincount(number, values)
    counts = np.bincount(number)
    drawn = np.random.default_rng(0).integers(len(counts), size=(_DRAWS, len(counts)))
    means = totals[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    low, high = np.quantile(means, [0.05, 0.95])
    return Measure(float(values.mean()), float(low), float(high))


def predictions(
    posterior: Posterior, slots: Sequence[int], judged: tuple[Floats, Sequence[str | None]]
) -> list[dict[str, Any]]:
    """Return answers as `stickslip-train cloth predict --json` prints them.

    `judged` has the familiarity of every clip and why it has no answer, or None; mu is None where
    there is a reason. `above` is the largest known mu where the last bin has as much probability as
    lies above an interval about the median: mu may be larger. Elsewhere it is None.
    """
    found = estimates(posterior.mu, posterior.bins, SHARE)
    above = [
        posterior.bins.high if ends else None for ends in posterior.mu[:, -1] >= (1.0 - SHARE) / 2
    ]
    columns = (part.tolist() for part in (found.median, found.low, found.high))
    told = [
        {"median": round(median, 6), "low": round(low, 6), "high": round(high, 6), "above": end}
        for median, low, high, end in zip(*columns, above, strict=True)
    ]
    return [
        {
            "slot": int(slot),
            "material": {
                name: round(float(p), 6) for name, p in zip(posterior.materials, row, strict=True)
            },
            "mu": mu if reason is None else None,
            "familiarity": round(float(familiarity), 3),
            "no_answer": reason,
        }
        for slot, row, mu, familiarity, reason in zip(
            slots, posterior.material, told, *judged, strict=True
        )
    ]


def score_predictions(
    answers: Sequence[Any], materials: Sequence[str], slots: Sequence[int], truth: Truth
) -> Scores:
    """Score a file of predictions of any method.

    `truth` is that of `slots`, each of which must be answered once.

    Where mu is null, as for a clip without an answer, `PRIOR` is scored.

    Raises ValueError, which names the answer, where one is not what `predictions` returns.
    """
    found: dict[int, tuple[list[float], tuple[float, float, float]]] = {}
    for place, answer in enumerate(answers):
        try:
            slot = int(answer["slot"])
            given = (
                PRIOR
                if answer["mu"] is None
                else [answer["mu"][name] for name in ("median", "low", "high")]
            )
            median, low, high = map(float, given)
            probabilities = {str(name): float(p) for name, p in answer["material"].items()}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(
                f"answer {place} must have slot, material and mu with median, low and "
                f"high: {error!r}"
            ) from None
        if slot not in slots:
            raise ValueError(f"slot of answer {place} must be one of the test set, and is {slot}")
        if slot in found:
            raise ValueError(f"slot {slot} is answered twice, at {place} for the second time")
        if not (np.isfinite([low, median, high]).all() and low <= median <= high):
            raise ValueError(
                f"mu of answer {place} must be finite with low <= median <= high, and is "
                f"{answer['mu']}"
            )
        unknown = set(probabilities) - set(materials)
        if unknown or any(not 0 <= p <= 1 for p in probabilities.values()):
            raise ValueError(
                f"material of answer {place} must give probabilities of {', '.join(materials)}"
            )
        found[slot] = [probabilities.get(name, 0.0) for name in materials], (median, low, high)
    missing = sorted(set(slots) - set(found))
    if missing:
        raise ValueError(
            f"every slot of the test set must be answered, and {len(missing)} are not, "
            f"{missing[0]} first"
        )
    materials_found, mu_found = (
        np.array(part) for part in zip(*(found[slot] for slot in slots), strict=True)
    )
    return _scores(Estimates(*mu_found.T), materials_found, truth)
