"""Searches for a minimum of the residual of observations, for `fit`.

A run also depends on the steps that its solver chooses. They are others at each value, so that the
residual has jumps, which may be larger than the noise lets the values be known. Near a minimum all
runs of a search therefore repeat the steps of one run. A search ends where the linear model of the
residual has no better values within the noise.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core.arrays import Floats, check_positive
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.scenes.family import SceneFamily
from stickslip_sim_core.scenes.scene import ClothRun

LEAST_FRACTION = 1e-3
"""Least value of a parameter that may be 0, over its largest: its logarithm needs a bound."""

CHANCE = 5.0
"""Standard deviations of a mean square by which chance alone may raise it above 1.

The mean of n squares has the standard deviation sqrt(2/n).
"""

TOLERANCE = 1e-5
"""Relative change of the residual's square and of the values at which a search ends anyhow.

It is far below what noise decides on.
"""

NEAR = 0.1
"""Distance to the minimum of the linear model at which a search has converged.

Its unit is the standard deviation by the noise. A nearer point is no better known.
"""

COARSE = 0.1
"""Share of the residual's square that the linear model can take away at which steps are fixed.

Steps that were chosen further away would not suit the minimum. The jumps of free steps are smaller
than this where steps are as exact as the noise.
"""

AT_BOUND = 2e-3
"""Relative distance from a bound within which a value is held by the bound."""

FINER = 4.0
"""Factor of the step error between a run and the one that tells what its steps do.

The error of a step grows with the square of its length, so steps are half as long.
"""

STEPS_SHARE = 2.0
"""Error of a run over its difference from one with steps half as long, for first order in time."""

LEAST_EFFECT = 1e-3
"""Change of the residual by all of a parameter's range, below which it has no effect.

It is to first order, and its unit is the standard deviation of the noise. Rounding leaves 1e-8.
"""

RUNS_MAX = 15
"""Runs from one start: a smooth residual takes 5 to 10."""

WORSE_MAX = 3
"""Runs of a search that may be worse than the best before.

Beside a branch a search creeps along the jump of the residual, and each try to cross it is worse.
Another start gets further.
"""


class Compared(NamedTuple):
    """A run compared with observations."""

    residual: Floats
    """Difference of run and observation over the noise: (N,)."""

    jacobian: Floats
    """Derivatives of the residual by each parameter: (N, P)."""

    groups: NDArray[np.intp] | None = None
    """Numbers of groups in which errors may depend on one another: (N,). None: no errors do."""


class Observation(Protocol):
    """Something that was seen of a run."""

    @property
    def count(self) -> int:
        """Number of numbers that were seen."""
        ...

    def check(self, run: ClothRun) -> None:
        """Check that the observation fits a run; raise ValueError."""
        ...

    def compare(self, run: ClothRun, derivatives: Sequence[Floats]) -> Compared:
        """Return the residual, and its derivatives from those of positions (frames, V, 3)."""
        ...


@dataclass(frozen=True)
class Prior:
    """A normal distribution of the logarithm of a positive parameter, before the fit.

    Raises:
        ValueError: A number is not positive.
    """

    median: float
    """In the unit of the parameter."""

    deviation: float
    """Standard deviation of the natural logarithm: 0.7 is a factor of 2."""

    def __post_init__(self) -> None:
        check_positive(median=self.median, deviation=self.deviation)

    def compare(self, value: float) -> tuple[float, float]:
        """Return the residual over the deviation, and its derivative by the value."""
        return float(np.log(value / self.median)) / self.deviation, 1.0 / (value * self.deviation)


class Minimum(NamedTuple):
    """Where a search from one start ended."""

    start: Mapping[str, float]
    values: Mapping[str, float]
    mean_square: float
    """Mean squared residual over the noise, or inf if no run from the start is valid."""
    runs: int
    converged: bool
    """Whether no better values are within reach of the linear model: see `NEAR`."""
    is_explained: bool
    """Whether the search converged, and noise explains what the run leaves."""
    message: str
    family: int = 0
    """Number of the family of scenes that was searched."""


_Key: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]
"""Values of a run, and the ends of steps that it repeats."""


class _JumpsError(Exception):
    """The residual jumps where the linear model has better values."""


class DifferentiatedRun(NamedTuple):
    """A run compared with all observations."""

    compared: Compared
    reason: str
    """Why the run is not valid, or empty."""
    step_ends: Floats
    """Ends of the solver's steps: (steps,) [s]."""

    @property
    def residual(self) -> Floats:
        """Return the residual: (N,)."""
        return self.compared.residual

    @property
    def jacobian(self) -> Floats:
        """Return its derivatives by each parameter: (N, P)."""
        return self.compared.jacobian


class Search:
    """Searches minima over logarithms of positive parameters, and over the others as they are."""

    def __init__(
        self,
        scenes: SceneFamily,
        observations: Sequence[Observation],
        names: Sequence[str],
        bounds: Mapping[str, tuple[float, float]],
        priors: Mapping[str, Prior],
    ) -> None:
        if not names:
            raise ValueError("parameters: must be at least one, got none")
        scenes.check_names(names)
        for argument, values in (("bounds", bounds), ("priors", priors)):
            for name in values:
                if name not in names:
                    raise ValueError(f"{argument}: must be of {', '.join(names)}, got {name!r}")
        self._scenes, self._observations, self._names = scenes, observations, tuple(names)
        self._priors = priors
        numbers = sum(observation.count for observation in observations)
        if numbers < len(names):
            raise ValueError(
                f"observations: must be at least as many numbers as parameters, {len(names)}, "
                f"got {numbers}"
            )
        self._count = numbers + len(priors)
        self._low, self._high = np.array([self._bounds(name, bounds) for name in names]).T
        self._is_log = self._low > 0.0
        for name in priors:
            if not self._is_log[self._names.index(name)]:
                raise ValueError(
                    f"priors: must be of parameters above 0, and {name} may be negative"
                )
        # A search asks for the residual and then for the Jacobian of the same point.
        self._runs: dict[_Key, DifferentiatedRun] = {}
        self._count_of_runs = 0
        # The steps that all runs of a search repeat near its minimum.
        self._step_ends: Floats | None = None
        # The runs in which searches ended, by their values.
        self._minima: dict[tuple[float, ...], DifferentiatedRun] = {}

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
        begin = np.array([start[name] for name in self._names])
        if not ((begin >= self._low) & (begin <= self._high)).all():
            raise ValueError(f"start: must be within the bounds, got {dict(start)}")
        runs_before = self._count_of_runs
        self._step_ends = None
        first = self._run(start)
        if first.reason:
            reason = f"start: no run is valid from any of them: {first.reason}"
            return Minimum(start, start, np.inf, 1, False, False, reason)
        effects = np.linalg.norm(first.jacobian, axis=0) * (self._high - self._low)
        without = [
            name for name, effect in zip(self._names, effects, strict=True) if effect < LEAST_EFFECT
        ]
        if without:
            reason = f"parameters: {without[0]} has no effect on the observations"
            return Minimum(start, start, np.inf, 1, False, False, reason)
        # The search needs a start between the bounds, and not on one of them.
        inside = self._transformed(begin.clip(1.001 * self._low, 0.999 * self._high))
        z, message = self._descended(inside, lambda z: self._gain(z) <= COARSE, RUNS_MAX)
        free_runs = self._count_of_runs - runs_before
        if free_runs < RUNS_MAX and self._gain(z) <= COARSE:
            self._repeat_steps_of(z)
            z, message = self._descended(z, self._is_near, RUNS_MAX - free_runs)
        values = self._values(z)
        self._minima[tuple(values.values())] = self._run(values)
        freedom = max(self._count - len(self._names), 1)
        mean_square = float(np.sum(self._at(z).residual ** 2)) / freedom
        converged = self._is_near(z)
        return Minimum(
            start,
            values,
            mean_square,
            self._count_of_runs - runs_before,
            converged,
            converged and mean_square <= 1.0 + CHANCE * (2.0 / freedom) ** 0.5,
            message,
        )

    def _repeat_steps_of(self, z: Floats) -> None:
        """Let all runs from now on repeat the steps of the run at a point."""
        run = self._at(z)
        self._step_ends = run.step_ends
        # The run itself would only be repeated.
        self._runs[self._key(self._values(z))] = run

    def _descended(
        self, begin: Floats, is_over: Callable[[Floats], bool], runs: int
    ) -> tuple[Floats, str]:
        """Return the best point of a search by least squares, and why it ended."""
        from scipy.optimize import least_squares

        best = begin
        least_square = np.inf
        worse_runs = 0

        def residual(z: Floats) -> Floats:
            nonlocal best, least_square, worse_runs
            residual = self._at(z).residual
            square = float(np.sum(residual**2))
            if square < least_square:
                best = z.copy()
                least_square = square
            elif square != least_square:
                worse_runs += 1
            if worse_runs > WORSE_MAX:
                raise _JumpsError
            return residual

        def stop(z: Floats) -> None:
            if is_over(z):
                raise StopIteration

        try:
            solution: Any = least_squares(
                residual,
                begin,
                jac=self._by_transformed,
                bounds=(self._transformed(self._low), self._transformed(self._high)),
                x_scale="jac",
                xtol=TOLERANCE,
                ftol=TOLERANCE,
                max_nfev=runs,
                callback=stop,
            )
        except _JumpsError:
            return (
                best,
                f"{worse_runs} runs were worse than the best before, since the residual jumps",
            )
        return best, str(solution.message)

    def _is_near(self, z: Floats) -> bool:
        """Return whether the minimum of the linear model is within `NEAR` standard deviations."""
        # Noise that is larger than its given size makes the minimum as much less known.
        excess = max(float(np.mean(self._at(z).residual ** 2)), 1.0)
        return self._decrease(z) <= NEAR**2 * excess

    def _gain(self, z: Floats) -> float:
        """Return the share of the residual's square that the linear model can take away."""
        # Nothing can be taken away from a residual of 0.
        return self._decrease(z) / (float(np.sum(self._at(z).residual ** 2)) or 1.0)

    def _decrease(self, z: Floats) -> float:
        """Return how much less the residual's square is at the minimum of the linear model.

        It is also the square of the distance of that minimum, in standard deviations by the noise.
        """
        run = self._at(z)
        values = np.array(list(self._values(z).values()))
        down = run.jacobian.T @ run.residual
        # A bound holds a value that the residual pulls over it.
        width = AT_BOUND * np.maximum(np.abs(self._low), np.abs(self._high))
        is_low = (values <= self._low + AT_BOUND * np.abs(self._low)) & (down > 0.0)
        is_high = (values >= self._high - width) & (down < 0.0)
        is_free = ~(is_low | is_high)
        J = run.jacobian[:, is_free]
        return float(down[is_free] @ np.linalg.pinv(J.T @ J) @ down[is_free])

    def _by_transformed(self, z: Floats) -> Floats:
        values = self._values(z)
        return self._run(values).jacobian * self.rates(values)

    def run_at(self, values: Mapping[str, float]) -> DifferentiatedRun:
        """Return the run with these values, differentiated by all parameters."""
        return self._run(values)

    def residual_at(self, values: Mapping[str, float]) -> Floats | None:
        """Return the residual of a run without derivatives, or None if it is not valid."""
        run = self._scenes.scene(**values).run()
        return self._compared(run, [], values).residual if run.valid else None

    def rates(self, values: Mapping[str, float]) -> Floats:
        """Return the derivatives of values by the variables of the search: (P,).

        A variable is the logarithm of a positive value, or else the value itself.
        """
        return np.where(self._is_log, [values[name] for name in self._names], 1.0)

    def moved(self, values: Mapping[str, float], shift: Floats) -> dict[str, float]:
        """Return values after a shift of the variables (P,), within the bounds."""
        begin = np.array([values[name] for name in self._names])
        return self._values(self._transformed(begin) + shift)

    def covariance(self, minimum: Minimum) -> Floats:
        """Return the covariance of the values (P, P) by the noise, and by what it leaves."""
        compared = self._minima[tuple(minimum.values.values())].compared
        return covariance_by_noise(compared, minimum.mean_square)

    def shift_by_steps(self, minimum: Minimum) -> Floats:
        """Return how far the minimum (P,) may be off by the steps of its run, or NaN."""
        scene = self._scenes.scene(**minimum.values)
        finer = replace(scene, preset=_finer(scene.preset)).run()
        if not finer.valid:
            return np.full(len(self._names), np.nan)
        now = self._minima[tuple(minimum.values.values())]
        change = self._compared(finer, [], minimum.values).residual - now.residual
        J = now.jacobian
        return np.asarray(-STEPS_SHARE * np.linalg.pinv(J.T @ J) @ (J.T @ change))

    def _at(self, z: Floats) -> DifferentiatedRun:
        return self._run(self._values(z))

    def _run(self, values: Mapping[str, float]) -> DifferentiatedRun:
        key = self._key(values)
        if key not in self._runs:
            self._runs[key] = self._simulated(values)
            self._count_of_runs += 1
        return self._runs[key]

    def _key(self, values: Mapping[str, float]) -> _Key:
        steps = () if self._step_ends is None else tuple(self._step_ends.tolist())
        return tuple(values.values()), steps

    def _simulated(self, values: Mapping[str, float]) -> DifferentiatedRun:
        scene = self._scenes.with_values(values).differentiated(self._names)
        run = replace(scene, step_ends=self._step_ends).run()
        shape = (self._count, len(self._names))
        none = Compared(np.full(shape[0], np.nan), np.full(shape, np.nan))
        derivatives = [run.sensitivities[name].positions for name in self._names]
        if not run.valid:
            return DifferentiatedRun(none, run.reason, run.step_ends)
        if not np.isfinite(derivatives).all():
            return DifferentiatedRun(none, "the derivatives could not be solved", run.step_ends)
        return DifferentiatedRun(self._compared(run, derivatives, values), "", run.step_ends)

    def _compared(
        self, run: ClothRun, derivatives: Sequence[Floats], values: Mapping[str, float]
    ) -> Compared:
        """Return a run with these values compared with all observations, and then the priors."""
        for observation in self._observations:
            observation.check(run)
        parts = [observation.compare(run, derivatives) for observation in self._observations]
        parts += [
            self._compared_with_prior(name, values[name], len(derivatives)) for name in self._priors
        ]
        return Compared(
            np.concatenate([part.residual for part in parts]),
            np.concatenate([part.jacobian for part in parts]),
            _joined([part.groups for part in parts], [len(part.residual) for part in parts]),
        )

    def _compared_with_prior(self, name: str, value: float, derivatives: int) -> Compared:
        residual, rate = self._priors[name].compare(value)
        by = np.zeros((1, derivatives))
        # A run without derivatives has a residual alone.
        if derivatives:
            by[0, self._names.index(name)] = rate
        return Compared(np.array([residual]), by)


def covariance_by_noise(compared: Compared, mean_square: float) -> Floats:
    """Return the covariance of the values (P, P) by the noise, and by what it leaves.

    It is as much larger as points of a group tell the same.
    """
    J = compared.jacobian
    excess = max(mean_square, 1.0) * dependence(compared)
    return np.asarray(excess * np.linalg.pinv(J.T @ J))


def dependence(compared: Compared) -> float:
    """Return how many points of a group have one independent error together, 1 or more.

    The square of the sum of n independent errors is n times that of one in the mean. Of errors of
    which c are one, it is c times as large.
    """
    if compared.groups is None:
        return 1.0
    is_grouped = compared.groups >= 0
    errors = compared.residual[is_grouped]
    square = float(errors @ errors)
    # What leaves no error has no dependent one either.
    if not square:
        return 1.0
    sums = np.bincount(compared.groups[is_grouped], weights=errors)
    return max(float(sums @ sums) / square, 1.0)


def _joined(
    parts: Sequence[NDArray[np.intp] | None], counts: Sequence[int]
) -> NDArray[np.intp] | None:
    """Return the groups of several observations, without shared numbers; -1 is no group."""
    if all(part is None for part in parts):
        return None
    joined = []
    begin = 0
    for part, count in zip(parts, counts, strict=True):
        if part is None:
            joined.append(np.full(count, -1, np.intp))
        else:
            joined.append(begin + part)
            begin += int(part.max()) + 1
    return np.concatenate(joined)


def _finer(settings: SolverSettings) -> SolverSettings:
    """Return settings whose steps are half as long."""
    error = settings.step_error
    return replace(
        settings,
        time_step=settings.time_step / FINER**0.5,
        longest_step=settings.longest_step / FINER**0.5,
        step_error=None if error is None else error / FINER,
    )
