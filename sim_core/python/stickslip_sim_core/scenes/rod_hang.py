"""Hanging rods: from their three numbers to shapes at rest."""

from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from typing import Any

import numpy as np

from stickslip_sim_core.rods.labels import other_minima, reach, self_contact_distance
from stickslip_sim_core.rods.solve import solve_rods
from stickslip_sim_core.scenes.kind import Kind, OnFrame, Outcome

CURVES = ("centerline", "curvature", "frame")

_settings = itemgetter("poisson", "elements", "points")


def simulate(
    simulations: Sequence[Mapping[str, Any]], _on_frame: OnFrame | None = None
) -> list[Outcome]:
    """Solve rods (gamma, phi0, phi1, poisson, elements, points), grouped by their settings.

    The numbers of a rod do not depend on the other rods.
    """
    # The solver takes many rods in one call, but only with the same settings.
    alike: dict[tuple[Any, ...], list[int]] = {}
    for i, rod in enumerate(simulations):
        alike.setdefault(_settings(rod), []).append(i)
    outcomes: dict[int, Outcome] = {}
    for indices in alike.values():
        outcomes.update(zip(indices, _solved([simulations[i] for i in indices]), strict=True))
    return [outcomes[i] for i in range(len(simulations))]


def _solved(rods: Sequence[Mapping[str, Any]]) -> Iterable[Outcome]:
    """Yield the outcomes of rods with the same settings."""
    settings = dict(zip(("poisson", "elements", "points"), _settings(rods[0]), strict=True))
    parameters = np.array([[rod[name] for rod in rods] for name in ("gamma", "phi0", "phi1")])
    solution = solve_rods(*parameters, **settings)
    good = solution.converged & solution.stable
    # A rod without an equilibrium has NaN for a centreline, and no labels.
    if good.any():
        other = other_minima(*parameters, **settings, solution=solution)
        distance, far = (
            label(solution.centerline[good]) for label in (self_contact_distance, reach)
        )
    # From the number of a rod to its row among the good ones.
    row = np.cumsum(good) - 1
    for i in range(len(rods)):
        if not good[i]:
            reason = (
                "no stable equilibrium was found"
                if solution.converged[i]
                else "the solver did not converge"
            )
            yield Outcome(reason=reason)
            continue
        record = {name: getattr(solution, name)[i].astype(np.float32) for name in CURVES}
        record["multistable"] = other.multistable[i]
        record |= {"self_contact_distance": distance[row[i]], "reach": far[row[i]]}
        yield Outcome(record, {"energy": float(solution.energy[i])})


KIND = Kind(
    simulate,
    solver="stickslip_sim_core.rods",
    # Less than a second of work, so that a lost batch costs little.
    batch=512,
)
