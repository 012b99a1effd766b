"""Fits that are carried over to a finer mesh or to rival scenes, and rivals that are weighed.

The derivatives of a fine mesh cost most of its fit. The minimum of a coarse mesh is near, and the
derivatives of the coarse one suffice to walk from there: `refined` takes only residuals from the
finer mesh. A scene may also differ in what no parameter sets, such as how a fabric shears.
`refined` walks to such rivals likewise, and `mixed` weighs them by what they leave.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.fit import Fit
from stickslip_sim_core.fit_search import (
    NEAR,
    Compared,
    Observation,
    Prior,
    Search,
    covariance_by_noise,
    dependence,
)
from stickslip_sim_core.scenes.family import SceneFamily

MESH_SHARE = 1.0 / 3.0
"""Error of the finer mesh over its difference from one with edges twice as long.

Errors of order h^2 are 4 h^2 and h^2, and their difference is 3 h^2.
"""

CORRECTIONS_MAX = 4
"""Runs of a walk. The first step takes away most of the difference of the scenes."""

SAME_BRANCH = 2.0
"""Square of what the linear model leaves of the finer run, up to which it is on the same branch.

Its unit is that of the coarse minimum, or the noise where that is more. Cloth that lies on another
side leaves ten times as much, and meshes differ by less.
"""


ANOTHER_BRANCH = "the cloth lies on another side in these scenes, and the values are as before"
NOT_CONVERGED = "the walk did not converge"


class Target(NamedTuple):
    """Scenes to which a fit is carried over."""

    scenes: SceneFamily
    share: float = 0.0
    """Error of these scenes over their difference from the fitted ones, such as `MESH_SHARE`."""


@dataclass(frozen=True, eq=False)
class Refined:
    """A fit that was carried over to other scenes."""

    values: Mapping[str, float]
    covariance: Floats
    """Of the values (P, P), in their order: by the noise, by the steps and by the mesh."""

    by_steps: Mapping[str, float]
    """How far the values may be off by the steps of the fit's run."""

    by_mesh: Mapping[str, float]
    """How far the values may be off by these scenes, as `Target.share` has it."""

    mean_square: float
    """Mean squared residual over the noise."""

    independent: float
    """Number of observed numbers with independent errors."""

    runs: int
    """Runs of these scenes."""

    warning: str
    """Why the values may be wrong, or an empty text."""

    @property
    def deviations(self) -> Mapping[str, float]:
        """Standard deviations of the values."""
        deviations = np.sqrt(np.diag(self.covariance)).tolist()
        return dict(zip(self.values, deviations, strict=True))


def refined(
    answer: Fit | Refined,
    scenes: SceneFamily,
    targets: Mapping[str, Target],
    observations: Sequence[Observation],
    parameters: Sequence[str],
    *,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, Prior] | None = None,
) -> dict[str, Refined]:
    """Carry a fit over to other scenes, such as those of a finer mesh.

    Each step is to the minimum of a linear model: the residual of a run of the other scenes, with
    the derivatives of one run of the fitted scenes.

    Args:
        answer: The fit of `scenes`, or one that was carried over to them.
        scenes: The family of scenes that explains the observations best.
        targets: Scenes with the same parameters, by a name.
        observations: Those of the fit.
        parameters: Those of the fit, and others that are known by their priors alone. They begin
            with their values in `scenes`.
        bounds: Those of the fit.
        priors: Distributions of some parameters before the fit.

    Raises:
        ValueError: An argument breaks its rule, or the run at the values of the fit is not valid.
    """

    def search(family: SceneFamily) -> Search:
        return Search(family, observations, parameters, bounds or {}, priors or {})

    coarse = search(scenes)
    values = coarse.starts(dict(answer.values), 1, 0)[0]
    run = coarse.run_at(values)
    if run.reason:
        raise ValueError(f"answer: the run at its values is not valid: {run.reason}")
    jacobian = run.jacobian * coarse.rates(values)
    by_steps = np.array([answer.by_steps.get(name, 0.0) for name in parameters])
    answers = {}
    for name, target in targets.items():
        walk = _Walk(search(target.scenes), run.compared._replace(jacobian=jacobian), values)
        walk.go()
        answers[name] = walk.refined(target.share, np.nan_to_num(by_steps))
    return answers


class _Walk:
    """Walks to the minimum of other scenes by the derivatives of one run."""

    def __init__(self, scenes: Search, compared: Compared, values: Mapping[str, float]) -> None:
        self._scenes = scenes
        self._compared = compared
        self._values = dict(values)
        self._residual = self._first = scenes.residual_at(values)
        self._runs = 1
        self._warning = ""

    def go(self) -> None:
        """Walk until the linear model has no better values within the noise, or a run is worse."""
        if self._first is None or not self._is_same_branch(self._first):
            self._warning = ANOTHER_BRANCH
            return
        residual = self._first
        while True:
            shift = _shift(self._compared.jacobian, residual)
            change = self._compared.jacobian @ shift
            excess = max(float(residual @ residual) / len(residual), 1.0)
            if float(change @ change) <= NEAR**2 * excess:
                return
            if self._runs == CORRECTIONS_MAX:
                break
            values = self._scenes.moved(self._values, shift)
            moved = self._scenes.residual_at(values)
            self._runs += 1
            if moved is None or float(moved @ moved) >= float(residual @ residual):
                break
            self._values, self._residual = values, moved
            residual = moved
        self._warning = NOT_CONVERGED

    def _is_same_branch(self, first: Floats) -> bool:
        remaining = first + self._compared.jacobian @ _shift(self._compared.jacobian, first)
        coarse = float(self._compared.residual @ self._compared.residual)
        return float(remaining @ remaining) <= SAME_BRANCH * max(coarse, len(first))

    def refined(self, share: float, by_steps: Floats) -> Refined:
        """Return where the walk ended. `by_steps` are deviations of the values by the steps."""
        names = list(self._values)
        if self._residual is None or self._first is None:
            unknown = np.full((len(names), len(names)), np.inf)
            nothing = dict.fromkeys(names, np.nan)
            return Refined(
                self._values, unknown, nothing, nothing, np.inf, 0.0, self._runs, self._warning
            )
        compared = self._compared._replace(residual=self._residual)
        square = float(self._residual @ self._residual)
        mean_square = square / max(len(self._residual) - len(names), 1)
        rates = self._scenes.rates(self._values)
        change = self._first - self._compared.residual
        by_mesh = share * rates * _shift(self._compared.jacobian, change)
        by_noise = covariance_by_noise(compared, mean_square) * np.outer(rates, rates)
        # Only the sizes of shifts by steps are known, not how they go together.
        covariance = by_noise + np.outer(by_mesh, by_mesh) + np.diag(by_steps**2)
        return Refined(
            self._values,
            covariance,
            dict(zip(names, by_steps.tolist(), strict=True)),
            dict(zip(names, np.abs(by_mesh).tolist(), strict=True)),
            mean_square,
            len(self._residual) / dependence(compared),
            self._runs,
            self._warning,
        )


def _shift(jacobian: Floats, residual: Floats) -> Floats:
    """Return how far the minimum of the linear model is: (P,)."""
    return np.asarray(-np.linalg.pinv(jacobian) @ residual)


@dataclass(frozen=True, eq=False)
class Mixture:
    """Values by fits of rival scenes together."""

    values: Mapping[str, float]
    """Means over the rivals."""

    deviations: Mapping[str, float]
    """Standard deviations: those of the fits, and that of their values among one another."""

    weights: Sequence[float]
    """Probability of each rival after the fit."""


def mixed(rivals: Sequence[Refined], probabilities: Sequence[float]) -> Mixture:
    """Weigh fits of rival scenes to the same observations by what they leave.

    The size of the noise is that of the best rival. The logarithm of a weight falls by half of what
    a rival leaves beyond that, over the noise, summed over the independent numbers.

    Args:
        rivals: Fits of the rivals.
        probabilities: Probability of each before the fit.

    Raises:
        ValueError: There is no rival, or not one positive probability for each.
    """
    if not rivals or len(probabilities) != len(rivals) or not min(probabilities) > 0.0:
        raise ValueError(
            f"probabilities: must be a positive one for each of {len(rivals)} rivals, "
            f"got {list(probabilities)}"
        )
    best = min(rivals, key=lambda rival: rival.mean_square)
    logarithms = np.array(
        [
            np.log(probability)
            - 0.5 * best.independent * (rival.mean_square / best.mean_square - 1.0)
            for rival, probability in zip(rivals, probabilities, strict=True)
        ]
    )
    weights = np.exp(logarithms - logarithms.max())
    weights /= weights.sum()
    values, deviations = {}, {}
    for name in rivals[0].values:
        each = np.array([rival.values[name] for rival in rivals])
        spread = np.array([rival.deviations[name] for rival in rivals])
        values[name] = float(weights @ each)
        # A rival without a valid run has no weight, and no finite deviation.
        is_weighed = weights > 0.0
        variances = np.where(is_weighed, spread, 0.0) ** 2 + (each - values[name]) ** 2
        variance = weights @ variances
        deviations[name] = float(np.sqrt(variance))
    return Mixture(values, deviations, weights.tolist())
