"""Names the faults that a row of cells shows: one rule for each fault that simulators had."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

from stickslip_measure import experiments
from stickslip_measure.campaign import CALIBRATED, Cell, convergence

UNIT = 1e-3
"""Largest deviation of the size at the start."""

CLOCK = 0.02
"""Largest deviation of the acceleration of a fall."""

UNITS = (1e-3, 1e3)
"""Accelerations over g of a simulator that takes millimetres for metres, or metres for them."""

EQUAL_MASSES = 0.05
"""Largest deviation of a tilt from that of equal masses, for which masses are wrong.

A plate that tilts by another angle has not settled, or its solver has not converged.
"""

CLAMP = 0.25
"""Distance of the clamp from its place from which on it is wrong [cells]."""

FACTOR = 0.03
"""Deviation of friction or bending from which on a factor is named."""

AGREEMENT = 0.03
"""Largest spread of the values of one factor."""

AGREEING = 2
"""Least number of experiments that show a factor."""

CREEP = 0.1
"""Displacement in 10 s from which on cloth creeps [mm]."""


@dataclass(frozen=True)
class Finding:
    """A fault, and the evidence for it."""

    fault: str
    evidence: str

    spoiled: tuple[str, ...] = ()
    """Experiments whose values are wrong because of it."""

    @property
    def text(self) -> str:
        """The evidence, and what is wrong because of the fault."""
        if not self.spoiled:
            return self.evidence
        return f"{self.evidence}; because of this, values are wrong: {', '.join(self.spoiled)}"


Rows = dict[str, list[Cell]]
"""Cells of one row, by experiment."""


def units(row: Rows) -> Finding | None:
    """Find lengths in another unit."""
    cell = _only(row, "fall")
    if cell is None or cell.value is None:
        return None
    scale = cell.details["size at the start over the scene's"]
    if abs(scale - 1.0) > UNIT:
        return Finding(
            "lengths are in another unit",
            f"before the first step, positions are {scale:.6g} times those of the scene"
            + (": millimetres for metres" if abs(scale / 1e3 - 1.0) < UNIT else ""),
        )
    if any(abs(cell.value / ratio - 1.0) < CLOCK for ratio in UNITS):
        return Finding(
            "lengths are in another unit",
            f"a patch falls with {cell.value:.6g} g: millimetres are mixed with metres",
        )
    return None


def clock(row: Rows) -> Finding | None:
    """Find steps that cover another time than they state, or air that brakes."""
    cell = _only(row, "fall")
    if cell is None or cell.value is None or units(row) is not None:
        return None
    if abs(cell.value - 1.0) <= CLOCK:
        return None
    slowing = cell.details.get("late over early acceleration", 1.0)
    if slowing < 1.0 - CLOCK:
        return Finding(
            "something brakes a free fall",
            f"the acceleration falls to {slowing:.3f} of its start: drag or damping by default",
        )
    return Finding(
        "steps cover another time than they state",
        f"a patch falls with {cell.value:.3f} g: a second of its time is "
        f"{max(cell.value, 0.0) ** 0.5:.3f} s",
        tuple(name for name in experiments.MOTION if _is_wrong(row.get(name, []))),
    )


def masses(row: Rows) -> Finding | None:
    """Find vertices that all have the same mass."""
    cell = _only(row, "balance")
    if cell is None or cell.value is None or abs(cell.value - 1.0) > EQUAL_MASSES:
        return None
    return Finding(
        "vertex masses are wrong",
        f"a plate with an uneven mesh hangs tilted by {cell.value:.2f} of the angle that equal "
        "vertex masses bring; a vertex bears a third of its triangles",
    )


def clamp(row: Rows) -> Finding | None:
    """Find a clamp that is not where it should be."""
    offsets = [
        cell.details["clamp behind its place [cells]"]
        for cell in row.get("cantilever", [])
        if cell.value is not None
    ]
    if not offsets or abs(median(offsets)) < CLAMP:
        return None
    return Finding(
        "the clamp is not at its place",
        f"a strip begins to bend {median(offsets):.2f} cells behind the clamp, at every resolution",
    )


def friction(row: Rows) -> Finding | None:
    """Find a factor on friction, by experiments that a wrong time does not spoil."""
    names: Sequence[str] = experiments.FRICTION
    timing = clock(row)
    if timing is not None and timing.spoiled:
        names = [name for name in names if name not in experiments.MOTION]
    return _factor(row, names, "friction")


def bending(row: Rows) -> Finding | None:
    """Find a factor on bending stiffness."""
    return _factor(row, experiments.BENDING, "bending stiffness")


def sleep(row: Rows) -> Finding | None:
    """Find a simulator that stops to simulate."""
    asleep = [cell for cells in row.values() for cell in cells if cell.state == "sleeps"]
    if not asleep:
        return None
    names = ", ".join(sorted({cell.experiment for cell in asleep}))
    return Finding("the simulator sleeps", f"{names}: {asleep[0].reason}")


def creeping(row: Rows) -> Finding | None:
    """Find cloth that moves below the angle of slip."""
    cells = [cell for cell in row.get("creep", []) if cell.value is not None]
    values = [cell.value for cell in cells if cell.value is not None]
    if not values or median(values) < CREEP:
        return None
    return Finding("cloth creeps", f"{median(values):.3g} mm in 10 s at 90 % of the angle of slip")


RULES: tuple[Callable[[Rows], Finding | None], ...] = (
    units,
    clock,
    masses,
    clamp,
    friction,
    bending,
    sleep,
    creeping,
)


def _only(row: Rows, name: str) -> Cell | None:
    cells = row.get(name, [])
    return cells[0] if cells else None


def _is_wrong(cells: Sequence[Cell]) -> bool:
    """Return whether the value of a resolution deviates."""
    return any(cell.error is not None and abs(cell.error) > FACTOR for cell in cells)


def _settled_value(cells: Sequence[Cell]) -> float:
    """Return the limit of an experiment, or its finest value if all of them are near it."""
    known = convergence(cells).limit
    values = [cell.value for cell in sorted(cells, key=lambda cell: cell.cells) if cell.value]
    if not math.isnan(known) or len(values) < len(cells) or not values:
        return known
    spread = max(abs(value / values[-1] - 1.0) for value in values)
    return values[-1] if spread < AGREEMENT else math.nan


def _factor(row: Rows, names: Sequence[str], quantity: str) -> Finding | None:
    """Find a factor on which the limits of several experiments agree."""
    limits = {}
    for name in names:
        value = _settled_value(row.get(name, []))
        if not math.isnan(value):
            limits[name] = value
    if len(limits) < AGREEING:
        return None
    factor = median(limits.values())
    agreeing = {
        name: value for name, value in limits.items() if abs(value / factor - 1.0) < AGREEMENT
    }
    # Experiments that disagree show something else than a factor.
    if abs(factor - 1.0) < FACTOR or len(agreeing) < max(AGREEING, 0.6 * len(limits)):
        return None
    values = ", ".join(f"{name} {value:.3f}" for name, value in agreeing.items())
    return Finding(f"{quantity} is {factor:.3f} times the requested one", f"limits: {values}")


def row_of(cells: Sequence[Cell]) -> Rows:
    """Return the cells of one row by experiment."""
    row: Rows = {}
    for cell in cells:
        row.setdefault(cell.experiment, []).append(cell)
    return row


def findings(cells: Sequence[Cell]) -> list[Finding]:
    """Return the faults that the cells of one row show.

    A calibrated row shows none: its bending stiffness was changed on purpose.
    """
    if not cells or cells[0].row.endswith(CALIBRATED):
        return []
    row = row_of(cells)
    results = [rule(row) for rule in RULES]
    return [finding for finding in results if finding is not None]
