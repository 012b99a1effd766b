"""Fits of a scene's parameters to observations of its cloth.

The residual is that of the observations over their noise, and its Jacobian has the derivatives of
the run by the parameters. `scipy.optimize.least_squares` finds a minimum. A residual may have
several: cloth that falls to another side is another branch. A fit therefore goes on from other
starts until the observations are explained by their noise, and says how many minima it saw.

A last run with finer steps says how far steps move the values, and the standard deviations have
this share. SciPy comes with the extra `fit`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import product
from typing import Any

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.fit_search import RUNS_MAX, Compared, Minimum, Observation, Prior, Search
from stickslip_sim_core.scenes.family import SceneFamily

__all__ = [
    "Compared",
    "Fit",
    "Minimum",
    "Observation",
    "Prior",
    "check_observed",
    "check_scipy",
    "fit",
]

SAME_MINIMUM = 0.02
"""Relative difference of all parameters within which two starts ended in one minimum."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters that explain observations, and how well."""

    values: Mapping[str, float]
    """Of the best minimum."""

    covariance: Floats
    """Of the values (P, P), in their order: that by the noise, and that by the steps.

    It is that of one branch of the run: a value in another branch may be off by far more.
    """

    by_noise: Mapping[str, float]
    """Standard deviations of the values by the noise of the observations.

    Where the residual is larger than the noise, they are as much larger.
    """

    by_steps: Mapping[str, float]
    """How far the values may be off by the run's steps in time, or NaN.

    It is the change of the minimum with steps half as long, to first order, times `STEPS_SHARE`.
    It is NaN where that run is not valid.
    """

    mean_square: float
    """Mean squared residual over the noise: 1 if noise alone is left."""

    converged: bool
    """Whether the search for the best minimum converged."""

    searches: Sequence[Minimum]
    """Where the search from each start ended."""

    family: int
    """Number of the family of scenes of the best minimum."""

    is_explained: bool
    """Whether that search converged, and noise explains what the run leaves."""

    minima: int
    """Number of different minima among them."""

    @property
    def deviations(self) -> Mapping[str, float]:
        """Standard deviations of the values."""
        deviations = np.sqrt(np.diag(self.covariance)).tolist()
        return dict(zip(self.values, deviations, strict=True))

    @property
    def runs(self) -> int:
        """Number of simulated runs."""
        return sum(search.runs for search in self.searches)

    @property
    def warning(self) -> str:
        """Why the values may be wrong, or an empty text."""
        starts = len(self.searches)
        begun = "the search from 1 start" if starts == 1 else f"the searches from {starts} starts"
        ended = "1 minimum" if self.minima == 1 else f"{self.minima} minima"
        counted = f"{begun} ended in {ended}"
        several = f"several minima: {counted}, and " if self.minima > 1 else ""
        if not self.converged:
            return (
                f"{several or f'{counted}: '}the best search did not converge: the residual jumps "
                f"between near values, or {RUNS_MAX} runs are too few"
            )
        if not self.is_explained:
            return (
                f"{several or f'{counted}: '}the best leaves a residual of "
                f"{self.mean_square**0.5:.3g} times the noise. Give other starts or more of them, "
                "or check the noise"
            )
        unsure = [name for name, shift in self.by_steps.items() if not np.isfinite(shift)]
        if unsure:
            return "the run with finer steps is not valid: deviations leave out errors of steps"
        return f"several minima: {counted}; noise explains the best" if several else ""


def fit(
    scenes: SceneFamily | Sequence[SceneFamily],
    observations: Sequence[Observation],
    parameters: Sequence[str],
    *,
    start: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, Prior] | None = None,
    multistart: int = 3,
    seed: int = 0,
) -> Fit:
    """Fit parameters of a scene to observations.

    Args:
        scenes: Scenes that differ in the parameters. Several families differ in what no parameter
            sets, such as the seed that decides to which side cloth falls: each start is that of
            each family in turn.
        observations: Observations with their noise.
        parameters: Names of the parameters to fit.
        start: Values to start from. Parameters without one start from the values of `scenes`.
        bounds: Least and largest value of some parameters; the others have the range of `scenes`.
        priors: Distributions of some parameters before the fit. Each counts as one more
            observation.
        multistart: Number of starts. Those after the first are drawn from the bounds, and are used
            while the observations are not explained by their noise. With several families it is
            their number for each.
        seed: Seed of the starts.

    Raises:
        ImportError: SciPy is missing.
        ValueError: An argument breaks its rule, there are fewer observations than parameters, or
            at each start a parameter has no effect or the run is not valid.
    """
    check_scipy()
    families = [scenes] if isinstance(scenes, SceneFamily) else scenes
    if not families:
        raise ValueError("scenes: must be at least one family, got none")
    by_family = [
        Search(family, observations, parameters, bounds or {}, priors or {}) for family in families
    ]
    starts = [search.starts(start or {}, multistart, seed) for search in by_family]
    searches: list[Minimum] = []
    # All families have had their first start before one has its second.
    for turn, number in product(range(multistart), range(len(families))):
        minimum = by_family[number].minimum(starts[number][turn])
        searches.append(minimum._replace(family=number))
        if searches[-1].is_explained:
            break
    # A search that converged is better than one that did not, whatever it leaves.
    best = min(searches, key=lambda minimum: (not minimum.is_explained, minimum.mean_square))
    if not np.isfinite(best.mean_square):
        raise ValueError(best.message)
    search = by_family[best.family]
    by_noise = search.covariance(best)
    by_steps = search.shift_by_steps(best)
    covariance = by_noise + np.nan_to_num(np.outer(by_steps, by_steps))
    return Fit(
        best.values,
        covariance,
        dict(zip(parameters, np.sqrt(np.diag(by_noise)).tolist(), strict=True)),
        dict(zip(parameters, np.abs(by_steps).tolist(), strict=True)),
        best.mean_square,
        best.converged,
        searches,
        best.family,
        best.is_explained,
        _count_minima(searches),
    )


def check_scipy() -> None:
    """Check that SciPy is there.

    Raises:
        ImportError: It is missing; the message has the way to install it.
    """
    if find_spec("scipy") is None:
        raise ImportError("a fit needs SciPy: run `pip install './sim_core[fit]'`")


def _count_minima(searches: Sequence[Minimum]) -> int:
    """Return the number of different minima."""
    different: list[Floats] = []
    for search in searches:
        values = np.array(list(search.values.values()))
        is_known = any(
            np.allclose(values, known, rtol=SAME_MINIMUM, atol=0.0) for known in different
        )
        if np.isfinite(search.mean_square) and not is_known:
            different.append(values)
    return len(different)


def check_observed(name: str, values: Floats, shape: Sequence[int | None]) -> None:
    """Check the shape of observed numbers, and that they are finite.

    `shape` has None where any length will do.

    Raises:
        ValueError: A number is not finite, or the shape is another.
    """
    fits = len(values.shape) == len(shape) and all(
        wanted in (None, length) for wanted, length in zip(shape, values.shape, strict=True)
    )
    if not fits or not values.size:
        words = ", ".join("any" if length is None else str(length) for length in shape)
        raise ValueError(f"{name}: must have the shape ({words}), got {values.shape}")
    if not np.isfinite(values).all():
        place: Any = tuple(int(number) for number in np.argwhere(~np.isfinite(values))[0])
        raise ValueError(f"{name}: must be finite, and is not at {place}")
