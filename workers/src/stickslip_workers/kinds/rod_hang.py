"""Rods that hang: from parameters to one artifact of shapes at rest."""

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from stickslip_schemas.base.states import Reason
from stickslip_schemas.documents.tasks import RecordRef, SimulateOutput, TaskResult
from stickslip_schemas.store import Store

from stickslip_workers.kinds import Kind
from stickslip_workers.stages.records import Array, encode_records

if TYPE_CHECKING:
    from stickslip_schemas.kinds.rod_hang import RodHangSimulation

CURVES = ("centerline", "curvature", "frame")


def _simulate(simulations: Sequence["RodHangSimulation"], store: Store) -> list[TaskResult]:
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


def _solve(
    rods: Sequence["RodHangSimulation"], poisson: float, elements: int, points: int, store: Store
) -> list[TaskResult]:
    # Here, so that packing needs no compiled core.
    from stickslip_sim_core import other_minima, reach, self_contact_distance, solve_rods

    parameters = np.array([(rod.gamma, rod.phi0, rod.phi1) for rod in rods]).T
    solution = solve_rods(*parameters, poisson=poisson, elements=elements, points=points)
    accepted = np.flatnonzero(solution.converged & solution.stable)
    rows = {int(index): row for row, index in enumerate(accepted)}
    digest = ""
    if rows:
        other = other_minima(
            *parameters, poisson=poisson, elements=elements, points=points, solution=solution, thorough=False
        )
        arrays: dict[str, Array] = {
            name: np.asarray(getattr(solution, name)[accepted], dtype=np.float32) for name in CURVES
        }
        arrays["multistable"] = other.multistable[accepted]
        arrays["self_contact_distance"] = self_contact_distance(solution.centerline[accepted])
        arrays["reach"] = reach(solution.centerline[accepted])
        digest = store.publish(encode_records(arrays))
    return [
        TaskResult(
            outcome="succeeded",
            output=SimulateOutput(
                record=RecordRef(digest=digest, row=rows[index]),
                labels={"energy": float(solution.energy[index])},
            ),
        )
        if index in rows
        else _rejection(rod, converged=bool(solution.converged[index]))
        for index, rod in enumerate(rods)
    ]


def _rejection(rod: "RodHangSimulation", *, converged: bool) -> TaskResult:
    what = "no stable equilibrium was found" if converged else "the solver did not converge"
    return TaskResult(
        outcome="rejected",
        reason=Reason.solver_diverged,
        message=f"{what} at gamma = {rod.gamma:g}, phi0 = {rod.phi0:g}, phi1 = {rod.phi1:g}, "
        f"poisson = {rod.poisson:g} with {rod.elements} elements",
    )


KIND = Kind(
    simulate=_simulate,
    batch=512,  # small enough that a lost batch costs little: 512 rods are well below a second
    solver="stickslip_sim_core.rods",
)
