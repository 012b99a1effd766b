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
"""Median, low and high of somebody who knows only that mu is from 0 to 1.6."""

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
    """Fraction of the clips with an error below 0.1."""
    within_02: Measure
    coverage: Measure
    """Fraction of the clips whose 80 % interval holds the truth."""
    interval: Measure
    """Mean interval score [Gneiting and Raftery 2007, Eq. 43]: the width of the 80 % interval, and
    10 times the distance of the truth from it. Wide intervals, and wrong ones, have a large score.
    """


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Scores of the answers to some clips."""

    blind: Errors
    """Material not known."""
    top_1: Measure
    """Fraction of the clips whose likeliest material is the true one."""
    top_2: Measure
    bands: dict[str, Errors]


@dataclass(frozen=True, eq=False, kw_only=True)
class Truth:
    """True values of some clips, (clips,) each."""

    material: Integers
    mu: Floats
    run: Integers
    """Number of the simulation: errors count simulations and not clips."""


def _scores(estimated: Estimates, material: Floats, truth: Truth) -> Scores:
    """Return scores of estimates of mu and of probabilities of materials (clips, materials)."""
    # The rank of the true material counts those that are as likely: a tie is no hit.
    true_probability = material[np.arange(len(material)), truth.material][:, None]
    rank = (material >= true_probability).sum(axis=1) - 1
    bands: dict[str, Errors] = {}
    for low, high in BANDS:
        # The last band includes its upper end, mu = 1.6.
        is_last = high == BANDS[-1][1]
        in_band = (truth.mu >= low) & (truth.mu < high + is_last)
        if in_band.any():
            part = Estimates(
                estimated.median[in_band], estimated.low[in_band], estimated.high[in_band]
            )
            bands[f"{low:g} to {high:g}"] = errors(part, truth.mu[in_band], truth.run[in_band])
    return Scores(
        blind=errors(estimated, truth.mu, truth.run),
        top_1=measure((rank < 1).astype(float), truth.run),
        top_2=measure((rank < 2).astype(float), truth.run),
        bands=bands,
    )


def errors(estimated: Estimates, mu: Floats, run: Integers) -> Errors:
    """Return the errors of estimates of `mu`, (clips,), of the simulations `run`, (clips,)."""
    low, high = estimated.low, estimated.high
    error = np.abs(estimated.median - mu)
    is_inside = (low - _ROUNDING <= mu) & (mu <= high + _ROUNDING)
    beyond = np.maximum(low - mu, 0.0) + np.maximum(mu - high, 0.0)
    return Errors(
        clips=len(mu),
        simulations=len(np.unique(run)),
        mae=measure(error, run),
        within_01=measure((error < 0.1 - _ROUNDING).astype(float), run),
        within_02=measure((error < 0.2 - _ROUNDING).astype(float), run),
        coverage=measure(is_inside.astype(float), run),
        interval=measure(high - low + 2 / (1 - SHARE) * beyond, run),
    )


def measure(values: Floats, run: Integers) -> Measure:
    """Return the mean of `values` (clips,), and its 5 % and 95 % quantiles.

    The quantiles are over simulations that are drawn with replacement.
    """
    _, number = np.unique(run, return_inverse=True)
    totals = np.bincount(number, values)
    counts = np.bincount(number)
    # A simulation is drawn with all of its clips, since they are not independent.
    draws = np.random.default_rng(0).integers(len(counts), size=(_DRAWS, len(counts)))
    means = totals[draws].sum(axis=1) / counts[draws].sum(axis=1)
    low, high = np.quantile(means, [0.05, 0.95])
    return Measure(float(values.mean()), float(low), float(high))


def predictions(
    posterior: Posterior, slots: Sequence[int], judged: tuple[Floats, Sequence[str | None]]
) -> list[dict[str, Any]]:
    """Return answers as `stickslip-train cloth predict --json` prints them.

    `judged` has the familiarity of every clip, and the reason of a refusal, or None. With a reason
    mu is None. `above` is the largest known mu if the last bin has as much probability as lies
    above an interval about the median, since mu may then be larger. Otherwise it is None.
    """
    estimated = estimates(posterior.mu, posterior.bins, SHARE)
    reaches_end = posterior.mu[:, -1] >= (1.0 - SHARE) / 2
    familiarity, reasons = judged
    answers = []
    for clip, slot in enumerate(slots):
        mu = {
            "median": round(float(estimated.median[clip]), 6),
            "low": round(float(estimated.low[clip]), 6),
            "high": round(float(estimated.high[clip]), 6),
            "above": posterior.bins.high if reaches_end[clip] else None,
        }
        probabilities = zip(posterior.materials, posterior.material[clip], strict=True)
        answer = {
            "slot": int(slot),
            "material": {name: round(float(p), 6) for name, p in probabilities},
            "mu": mu if reasons[clip] is None else None,
            "familiarity": round(float(familiarity[clip]), 3),
            "no_answer": reasons[clip],
        }
        answers.append(answer)
    return answers


@dataclass(frozen=True)
class _Answer:
    """An answer to one clip."""

    slot: int
    mu: tuple[float, float, float]
    """Median, low and high."""
    material: dict[str, float]


def _parsed(number: int, answer: Any) -> _Answer:
    """Return an answer of a file; raise ValueError, with its number in the file, if it is none."""
    try:
        mu = answer["mu"]
        # No answer is scored as the answer of somebody who knows only the range of mu.
        interval = PRIOR if mu is None else (mu["median"], mu["low"], mu["high"])
        median, low, high = map(float, interval)
        material = {str(name): float(p) for name, p in answer["material"].items()}
        parsed = _Answer(int(answer["slot"]), (median, low, high), material)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"answer {number} must have slot, material and mu with median, low and high: "
            f"{type(error).__name__}: {error}"
        ) from None
    if not (np.isfinite(parsed.mu).all() and low <= median <= high):
        raise ValueError(
            f"mu of answer {number} must be finite with low <= median <= high, and is "
            f"{answer['mu']}"
        )
    return parsed


def score_predictions(
    answers: Sequence[Any], materials: Sequence[str], slots: Sequence[int], truth: Truth
) -> Scores:
    """Score a file of predictions of any method.

    `truth` is that of `slots`, each of which must be answered once. If mu is null, as for a clip
    without an answer, `PRIOR` is scored.

    Raises ValueError, with the number of the answer, if one does not have the form of
    `predictions`.
    """
    by_slot: dict[int, _Answer] = {}
    for number, document in enumerate(answers):
        answer = _parsed(number, document)
        if answer.slot not in slots:
            raise ValueError(
                f"slot of answer {number} must be one of the test set, and is {answer.slot}"
            )
        if answer.slot in by_slot:
            raise ValueError(
                f"slot {answer.slot} is answered twice, at {number} for the second time"
            )
        unknown = set(answer.material) - set(materials)
        if unknown or any(not 0 <= p <= 1 for p in answer.material.values()):
            raise ValueError(
                f"material of answer {number} must give probabilities of {', '.join(materials)}"
            )
        by_slot[answer.slot] = answer
    missing = sorted(set(slots) - set(by_slot))
    if missing:
        raise ValueError(
            f"every slot of the test set must be answered, and {len(missing)} are not, "
            f"{missing[0]} first"
        )
    # The order of the truth is that of `slots`, and not that of the file.
    ordered = [by_slot[slot] for slot in slots]
    probabilities = [[answer.material.get(name, 0.0) for name in materials] for answer in ordered]
    intervals = np.array([answer.mu for answer in ordered])
    return _scores(Estimates(*intervals.T), np.array(probabilities), truth)
