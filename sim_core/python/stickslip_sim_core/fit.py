"""Fits of a scene's parameters to observations of its cloth.

The residual is that of the observations over their noise, and its Jacobian has the derivatives of
the run by the parameters. `scipy.optimize.least_squares` finds a minimum. A residual may have
several: cloth that falls to another side is another branch. A fit therefore goes on from other
starts until the observations are explained by their noise, and says how many minima it saw. SciPy
comes with the extra `fit`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.scenes.family import SceneFamily
from stickslip_sim_core.scenes.scene import ClothRun

LEAST_FRACTION = 1e-3
"""Least value of a parameter that may be 0, over its largest: its logarithm needs a bound."""

EXPLAINED = 1.5
"""Mean squared residual over the noise, up to which the noise explains the observations."""

SAME_MINIMUM = 0.02
"""Relative difference of all parameters within which two starts ended in one minimum."""

TOLERANCE = 1e-5
"""Relative change of the residual's square and of the values at which a search has converged.

It is far below what noise decides on.
"""

RUNS_MAX = 15
"""Runs from one start: a smooth residual takes 7 to 13.

Where the residual jumps, a search creeps from one jump to the next, and may end many standard
deviations off with a residual that noise could explain.
"""


class Observation(Protocol):
    """Something that was seen of a run."""

    @property
    def count(self) -> int:
        """Number of numbers that were seen."""
        ...

    def check(self, run: ClothRun) -> None:
        """Check that the observation fits a run; raise ValueError."""
        ...

    def residual(self, run: ClothRun) -> Floats:
        """Return the difference of run and observation over the noise: (N,)."""
        ...

    def jacobian(self, run: ClothRun, derivative: Floats) -> Floats:
        """Return the derivative of the residual, from that of positions (frames, V, 3): (N,)."""
        ...


class Minimum(NamedTuple):
    """Where a search from one start ended."""

    start: Mapping[str, float]
    values: Mapping[str, float]
    mean_square: float
    """Mean squared residual over the noise, or inf if no run from the start is valid."""
    runs: int
    converged: bool
    message: str

    @property
    def is_explained(self) -> bool:
        """Whether the search converged, and noise explains what the run leaves."""
        return self.converged and self.mean_square <= EXPLAINED


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters that explain observations, and how well."""

    values: Mapping[str, float]
    """Of the best minimum."""

    deviations: Mapping[str, float]
    """Standard deviations of the values, by the noise of the observations.

    They are those of one branch of the run: a value in another branch may be off by far more.
    """

    covariance: Floats
    """Of the values (P, P), in their order."""

    mean_square: float
    """Mean squared residual over the noise: 1 if noise alone is left."""

    converged: bool
    """Whether the search for the best minimum converged."""

    searches: Sequence[Minimum]
    """Where the search from each start ended."""

    minima: int
    """Number of different minima among them."""

    @property
    def runs(self) -> int:
        """Number of simulated runs."""
        return sum(search.runs for search in self.searches)

    @property
    def warning(self) -> str:
        """Why the values may be wrong, or an empty text."""
        counted = f"the searches from {len(self.searches)} starts ended in {self.minima} minima"
        if self.mean_square > EXPLAINED:
            return (
                f"several minima: {counted}, and the best leaves a residual of "
                f"{self.mean_square**0.5:.2g} times the noise. Give other starts or more of them"
            )
        if not self.converged:
            return (
                f"several minima: {counted}, and the best search did not converge in {RUNS_MAX} "
                "runs: the residual jumps between near values"
            )
        return f"several minima: {counted}; noise explains the best" if self.minima > 1 else ""


def fit(
    scenes: SceneFamily,
    observations: Sequence[Observation],
    parameters: Sequence[str],
    *,
    start: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    multistart: int = 3,
    seed: int = 0,
) -> Fit:
    """Fit parameters of a scene to observations.

    Args:
        scenes: Scenes that differ in the parameters.
        observations: Observations with their noise.
        parameters: Names of the parameters to fit.
        start: Values to start from. Parameters without one start from the values of `scenes`.
        bounds: Least and largest value of some parameters; the others have the range of `scenes`.
        multistart: Number of starts. Those after the first are drawn from the bounds, and are used
            while the observations are not explained by their noise.
        seed: Seed of the starts.

    Raises:
        ValueError: An argument breaks its rule, there are fewer observations than parameters, a
            parameter has no effect, or no start has a valid run.
    """
    search = _Search(scenes, observations, parameters, bounds or {})
    starts = search.starts(start or {}, multistart, seed)
    searches: list[Minimum] = []
    for values in starts:
        searches.append(search.minimum(values))
        if searches[-1].is_explained:
            break
    # A search that converged is better than one that did not, whatever it leaves.
    best = min(searches, key=lambda minimum: (not minimum.is_explained, minimum.mean_square))
    if not np.isfinite(best.mean_square):
        raise ValueError(f"start: no run is valid from any of them: {best.message}")
    covariance = search.covariance(best.values)
    deviations = np.sqrt(np.diag(covariance))
    return Fit(
        best.values,
        dict(zip(parameters, deviations.tolist(), strict=True)),
        covariance,
        best.mean_square,
        best.converged,
        searches,
        _count_minima(searches),
    )


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


class _Run(NamedTuple):
    residual: Floats
    """(N,)"""
    jacobian: Floats
    """By each parameter: (N, P)."""
    reason: str
    """Why the run is not valid, or empty."""


class _Search:
    """Searches minima over logarithms of positive parameters, and over the others as they are."""

    def __init__(
        self,
        scenes: SceneFamily,
        observations: Sequence[Observation],
        names: Sequence[str],
        bounds: Mapping[str, tuple[float, float]],
    ) -> None:
        if not names:
            raise ValueError("parameters: must be at least one, got none")
        scenes.check_names(names)
        for name in bounds:
            if name not in names:
                raise ValueError(f"bounds: must be of {', '.join(names)}, got {name!r}")
        self._scenes, self._observations, self._names = scenes, observations, tuple(names)
        self._count = sum(observation.count for observation in observations)
        if self._count < len(names):
            raise ValueError(
                f"observations: must be at least as many numbers as parameters, {len(names)}, "
                f"got {self._count}"
            )
        self._low, self._high = np.array([self._bounds(name, bounds) for name in names]).T
        self._is_log = self._low > 0.0
        # A search asks for the residual and then for the Jacobian of the same point.
        self._runs: dict[tuple[float, ...], _Run] = {}

    def _bounds(self, name: str, bounds: Mapping[str, tuple[float, float]]) -> tuple[float, float]:
        known = self._scenes.parameters[name]
        low, high = bounds.get(name, (known.low, known.high))
        if not known.low <= low < high <= known.high:
            raise ValueError(
                f"bounds: of {name} must ascend within {known.low:g} ... {known.high:g} "
                f"[{known.unit}], got {low:g} and {high:g}"
            )
        return (LEAST_FRACTION * high if low == 0.0 else low), high

    def starts(self, start: Mapping[str, float], count: int, seed: int) -> list[dict[str, float]]:
        """Return the first start, and others drawn from the bounds, evenly in logarithms."""
        if count < 1:
            raise ValueError(f"multistart: must be 1 or more, got {count}")
        # Imported here, so that importing the package stays quick.
        from scipy.stats import qmc

        first = self._scenes.with_values(start).parameters
        starts = [{name: first[name].value for name in self._names}]
        low, high = self._transformed(self._low), self._transformed(self._high)
        for share in qmc.Halton(len(self._names), rng=seed).random(count - 1):
            starts.append(self._values(low + share * (high - low)))
        return starts

    def _transformed(self, values: Floats) -> Floats:
        return np.where(self._is_log, np.log(np.where(self._is_log, values, 1.0)), values)

    def _values(self, z: Floats) -> dict[str, float]:
        values = np.where(self._is_log, np.exp(np.where(self._is_log, z, 0.0)), z)
        # The exponential of a logarithm may be outside its range by rounding.
        return dict(zip(self._names, values.clip(self._low, self._high).tolist(), strict=True))

    def minimum(self, start: Mapping[str, float]) -> Minimum:
        """Return where the search from a start ends."""
        from scipy.optimize import least_squares

        begin = np.array([start[name] for name in self._names])
        if not ((begin >= self._low) & (begin <= self._high)).all():
            raise ValueError(f"start: must be within the bounds, got {dict(start)}")
        runs_before = len(self._runs)
        first = self._run(start)
        if first.reason:
            return Minimum(start, start, np.inf, 1, False, first.reason)
        without = [
            name for name, by in zip(self._names, first.jacobian.T, strict=True) if not by.any()
        ]
        if without:
            raise ValueError(f"parameters: {without[0]} has no effect on the observations")
        solution: Any = least_squares(
            self._residual,
            # The search needs a start between the bounds, and not on one of them.
            self._transformed(begin.clip(1.001 * self._low, 0.999 * self._high)),
            jac=self._by_transformed,
            bounds=(self._transformed(self._low), self._transformed(self._high)),
            x_scale="jac",
            xtol=TOLERANCE,
            ftol=TOLERANCE,
            max_nfev=RUNS_MAX,
        )
        mean_square = 2.0 * float(solution.cost) / max(self._count - len(self._names), 1)
        runs = len(self._runs) - runs_before
        return Minimum(
            start,
            self._values(solution.x),
            mean_square,
            runs,
            bool(solution.status > 0),
            str(solution.message),
        )

    def _residual(self, z: Floats) -> Floats:
        return self._run(self._values(z)).residual

    def _by_transformed(self, z: Floats) -> Floats:
        values = self._values(z)
        rate = np.where(self._is_log, list(values.values()), 1.0)
        return self._run(values).jacobian * rate

    def covariance(self, values: Mapping[str, float]) -> Floats:
        """Return the covariance of values (P, P) by the noise of the observations."""
        J = self._run(values).jacobian
        return np.asarray(np.linalg.pinv(J.T @ J))

    def _run(self, values: Mapping[str, float]) -> _Run:
        key = tuple(values.values())
        if key not in self._runs:
            self._runs[key] = self._simulated(values)
        return self._runs[key]

    def _simulated(self, values: Mapping[str, float]) -> _Run:
        run = self._scenes.with_values(values).differentiated(self._names).run()
        none = np.full((self._count, len(self._names)), np.nan)
        derivatives = [run.sensitivities[name].positions for name in self._names]
        if not run.valid:
            return _Run(none[:, 0], none, run.reason)
        if not np.isfinite(derivatives).all():
            return _Run(none[:, 0], none, "the derivatives could not be solved")
        for observation in self._observations:
            observation.check(run)
        residual = [observation.residual(run) for observation in self._observations]
        by = [
            np.concatenate(
                [observation.jacobian(run, derivative) for observation in self._observations]
            )
            for derivative in derivatives
        ]
        return _Run(np.concatenate(residual), np.stack(by, axis=1), "")


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
