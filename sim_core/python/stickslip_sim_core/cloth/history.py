"""The history of a run: the measured numbers of each step, in the order of the steps.

A share over a whole run becomes small if the run goes on calmly after its worst moment. The checks
therefore judge the worst stretch of steps, which no later step can improve.
"""

import numpy as np

from stickslip_sim_core._sim_core import StepReport
from stickslip_sim_core.arrays import Floats

_COLUMNS = ("duration", "contact_work", "flow", "unconverged", "motion_error")


class StepHistory:
    """One row of measured numbers for each step.

    The rungs of the fallback ladder are not among them: `Cloth.total` has their sum.
    """

    def __init__(self) -> None:
        self._steps = 0
        # Both arrays have spare rows: the checks look at them many times while steps are added.
        self._rows = np.zeros((0, len(_COLUMNS)))
        self._friction = np.zeros((0, 0, 2))

    def add(self, duration: float, report: StepReport) -> None:
        """Add a step of `duration` [s]."""
        extremes = report.seen
        others = max(self._friction.shape[1], len(extremes.friction))
        if self._steps == len(self._rows) or others > self._friction.shape[1]:
            self._grow(others)
        self._rows[self._steps] = (
            duration,
            extremes.contact_work,
            extremes.flow,
            report.unconverged,
            report.motion_error,
        )
        self._friction[self._steps, : len(extremes.friction)] = np.reshape(
            extremes.friction, (-1, 2)
        )
        self._steps += 1

    def _grow(self, others: int) -> None:
        """Make room for as many steps again, and for friction with a number of others."""
        steps = max(64, 2 * self._steps)
        rows = np.zeros((steps, len(_COLUMNS)))
        rows[: self._steps] = self._rows[: self._steps]
        friction = np.zeros((steps, others, 2))
        friction[: self._steps, : self._friction.shape[1]] = self._friction[: self._steps]
        self._rows = rows
        self._friction = friction

    @property
    def friction(self) -> Floats:
        """Work of friction of each step, and its estimated error: (steps, others, 2) [J].

        The others are bodies, then surfaces, then sheets, with which cloth of another sheet rubs.
        """
        return self._friction[: self._steps]

    def column(self, name: str) -> Floats:
        """Return a number of each step: (steps,).

        `duration` [s]; `contact_work` and `flow` [J], see `StepReport.seen`; `unconverged`, 0
        or 1; `motion_error` [m], see `StepReport`.
        """
        return self._rows[: self._steps, _COLUMNS.index(name)]


def worst_stretch(part: Floats, whole: Floats, most: float) -> float:
    """Return the largest sum(part) over the whole of a stretch of steps, or 0 without steps.

        max over k of (P_k - P_j) / max(W_k - W_j, most),  j = min{i < k: W_k - W_i <= most}

    P and W are the cumulative sums. A stretch that ends with step k goes back as far as it has at
    most `most` of the whole, and has one step at least. A stretch with less is over `most`: a part
    of nothing counts no more than it is.

    The result belongs to the steps until now: later ones leave all earlier stretches as they are,
    and later ones without a part add none that is worse. NaN makes the result NaN.

    Args:
        part: Part of each step, 0 or more: (steps,).
        whole: Whole of each step, 0 or more, in the same unit or another: (steps,).
        most: Largest whole of a stretch of several steps, above 0.
    """
    if not len(part):
        return 0.0
    parts = np.append(0.0, np.cumsum(part))
    wholes = np.append(0.0, np.cumsum(whole))
    first = np.searchsorted(wholes, wholes[1:] - most, "left")
    # One step may have more than `most`, and is then a stretch by itself.
    first = np.minimum(first, np.arange(len(part)))
    return float(((parts[1:] - parts[first]) / np.maximum(wholes[1:] - wholes[first], most)).max())
