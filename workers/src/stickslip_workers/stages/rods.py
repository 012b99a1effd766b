"""Rods at rest: from parameters to one artifact of shapes."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from stickslip_schemas.states import Reason
from stickslip_schemas.store import Store
from stickslip_schemas.tasks import RecordRef, RodSimulation, SimulateOutput, TaskResult

from stickslip_workers.stages.records import encode_records

CURVES = ("centerline", "curvature", "frame")
"""What a record holds: float32, the arrays of the same names in the dataset."""


def simulate_rods(simulations: Sequence[RodSimulation], store: Store) -> list[TaskResult]:
    """Solve all rods together. A rod's numbers do not depend on which others are with it."""
    results: dict[int, TaskResult] = {}

    def settings(index: int) -> tuple[float, int, int]:
        rod = simulations[index]
        return rod.poisson, rod.elements, rod.points

    for (poisson, elements, points), group in groupby(sorted(range(len(simulations)), key=settings), key=settings):
        indices = list(group)
        solved = _solve([simulations[index] for index in indices], poisson, elements, points, store)
        results.update(zip(indices, solved, strict=True))
    return [results[index] for index in range(len(simulations))]


def _solve(rods: Sequence[RodSimulation], poisson: float, elements: int, points: int, store: Store) -> list[TaskResult]:
    from stickslip_sim_core import solve_rods  # here, so that packing needs no compiled core

    solution = solve_rods(
        np.array([rod.gamma for rod in rods]),
        np.array([rod.phi0 for rod in rods]),
        np.array([rod.phi1 for rod in rods]),
        poisson=poisson,
        elements=elements,
        points=points,
    )
    accepted = np.flatnonzero(solution.converged & solution.stable)
    rows = {int(index): row for row, index in enumerate(accepted)}
    digest = ""
    if rows:
        curves = {name: np.asarray(getattr(solution, name)[accepted], dtype=np.float32) for name in CURVES}
        digest = store.publish(encode_records(curves))
    return [
        TaskResult(
            outcome="succeeded",
            output=SimulateOutput(
                record=RecordRef(digest=digest, row=rows[index]),
                labels={"energy": float(solution.energy[index]), "stable": True},
            ),
        )
        if index in rows
        else _rejection(rod, converged=bool(solution.converged[index]))
        for index, rod in enumerate(rods)
    ]


def _rejection(rod: RodSimulation, *, converged: bool) -> TaskResult:
    what = "no stable equilibrium was found" if converged else "the solver did not converge"
    return TaskResult(
        outcome="rejected",
        reason=Reason.solver_diverged,
        message=f"{what} at gamma = {rod.gamma:g}, phi0 = {rod.phi0:g}, phi1 = {rod.phi1:g}, "
        f"poisson = {rod.poisson:g} with {rod.elements} elements",
    )
