"""Checks of a run of cloth: this table alone decides whether the run is valid.

The solver measures every step that it takes. The worst value of each check is stored with the
sample. A run with a value beyond its limit is not valid, and the check is the reason. A value that
is not a number is beyond every limit.

No judged value depends on what follows its worst moment: each is a largest value, a count, or that
of the worst stretch of steps (`history.worst_stretch`). A calm end therefore mends no run.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from stickslip_sim_core._sim_core import StepReport
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.history import worst_stretch
from stickslip_sim_core.cloth.presets import STEP_ERROR
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth

FLOW = 0.1
"""Flow of energy of the stretches in which work is judged, over the work that lifts all cloth by
the side of a cell.

Below it rounding alone would be judged: a sheet that begins 0.9 um inside a floor, and lies there,
has a flow of two rounding errors.
"""

FRICTION_ERROR = 0.03
"""Largest relative error of friction that a sample may have."""


@dataclass(frozen=True)
class Seen:
    """The evidence by which the checks judge a run."""

    cloth: Cloth
    """The cloth after its last step."""

    positions: Floats
    """(frames, V, 3) [m]"""

    crossings: int
    """Largest number of pairs of triangles that cross in a frame; 0 for cloth without self-contact.
    """

    motion_error_end: float | None = None
    """Distance of what drives the cloth from an even motion in the last step, up to the last frame
    [m]. None: the last step ends there, or all of it counts.
    """

    others: Sequence[str] = ()
    """Names of all bodies, then of all surfaces, then of all sheets; without them, numbers."""

    @property
    def total(self) -> StepReport:
        """The report of all steps together."""
        return self.cloth.total


@dataclass(frozen=True)
class Check:
    """One check. Its name is also the name of the label and the code of the reason."""

    name: str
    formula: str
    """The measured quantity, in words."""

    value: Callable[[Seen], float]
    limit: float | None
    """Largest value of a valid run; None: the value is recorded and not judged."""

    why: str
    """The grounds for the limit."""

    unit: str = "1"

    advice: Callable[[Seen], str] = lambda _seen: ""
    """What is at fault and what to change, for the reason."""


CHECKS = (
    Check(
        "not_finite",
        "coordinates of vertices that are not finite numbers",
        lambda seen: float(np.count_nonzero(~np.isfinite(seen.positions))),
        0.0,
        "no such position is a result",
    ),
    Check(
        "jumps",
        "distance of a body, holder or surface from an even motion within a step, over the "
        "preset's step error",
        lambda seen: _uneven(seen) / (seen.cloth.preset.step_error or STEP_ERROR),
        1.0,
        "steps are halved until it is 0.25; where the shortest are not enough, something "
        "jumps or is shaken by 40 g",
    ),
    Check(
        "unconverged",
        "steps that ended above the tolerance in the worst stretch of 500 steps, over the one "
        "that the preset allows there",
        lambda seen: _unconverged(seen.cloth),
        1.0,
        "a preset allows a share of its steps, 0.002; the golden and everyday scenes have none, "
        "and walls that close on cloth have many in a row",
    ),
    Check(
        "budget",
        "most iterations of Newton's method in a second of scene time, over the 50,000 at "
        "which the run ends, or for one step, over the 1,000 at which it ends",
        lambda seen: seen.cloth.spent,
        1.0,
        "where holders, bodies and cloth cannot all have their way, steps take ever more, and some "
        "have no solution; steps that end well took up to 402",
    ),
    Check(
        "crossings",
        "pairs of triangles that cross in a frame, where cloth touches itself",
        lambda seen: float(seen.crossings),
        0.0,
        "contact keeps cloth apart",
    ),
    Check(
        "contact_gain",
        "sum over steps and vertices of max(0, R_n (g_1 - g_0) + R_t . u) over the flow of "
        "energy, in the worst stretch: work that bodies do on the motion against them, with the "
        "force R, the gap g at the start and end of the step, and the slip u",
        lambda seen: worst_stretch(
            seen.cloth.history.column("contact_work"),
            seen.cloth.history.column("flow"),
            FLOW * _lift(seen.cloth),
        ),
        1e-3,
        "contact takes energy from the motion against a body and never gives any; a body that "
        "pushes out what is in it does",
    ),
    Check(
        "energy_gain",
        "largest energy gained beyond the work of gravity, holders and bodies, over the flow "
        "of energy",
        lambda seen: seen.total.seen.gain / max(seen.total.seen.flow, FLOW * _lift(seen.cloth)),
        None,
        "recorded: good runs reach 0.9 %, and bad ones begin at 1 %",
    ),
    Check(
        "penetration",
        "largest depth in a body at the end of a step, beyond the sagitta of flat triangles "
        "on its round face, over "
        "the side of a cell",
        lambda seen: seen.total.seen.depth,
        0.1,
        "contact keeps vertices out of bodies; held vertices and blunt triangles can be driven in",
        "cells",
    ),
    Check(
        "passages",
        "triangles that pass the core of a body in a step: the centre of a ball, the axis of "
        "a rod, the middle plane "
        "of a box",
        lambda seen: float(seen.total.seen.passages),
        0.0,
        "cloth that passed a core went through the body",
    ),
    Check(
        "stretch",
        "largest principal stretch of a triangle at the end of a step",
        lambda seen: seen.total.seen.stretch,
        1.25,
        "the fabrics were measured up to 1 + 1/6; drops reach 1.09 and heaps 1.17",
    ),
    Check(
        "friction_error",
        "relative error of the coefficient of friction with one body, surface or sheet by the size "
        "of cells: mean of e over the work of friction, where this work lifts the cloth by a cell. "
        "Cloth that turns by an angle a along a cell has e = a^4/75 at vertices, which are "
        "corrected for cells, and, on bodies, the correction itself as far as weight presses or "
        "the face is round both ways; and a^2/8 elsewhere and over radii below 0.7 cells",
        lambda seen: max(_friction_errors(seen.cloth), default=0.0),
        FRICTION_ERROR,
        "18 strips pulled over box edges and creases of meshes of 0.25 to 2 cells, mu 0.1 to 0.6: "
        "at most 0.013 where mu is right within 2 %, at least 0.053 where it is 5 % off or more, "
        "and 0.24 to 0.93 where cells catch",
        advice=lambda seen: _sharpest(seen),
    ),
    Check(
        "step_error",
        "largest distance by which one step alone misplaces a vertex: the smaller one of its "
        "distances from where its velocity leads it and from where its velocity and acceleration "
        "do, unless it lands or sticks; and dv T where friction turns within the step, with the "
        "uncertain velocity dv and the longest step T",
        lambda seen: 1e3 * seen.total.step_error,
        10.0,
        "an impact at a speed v is misplaced by up to v times the shortest step: falls from 2 cm "
        "to 1 m reach 6.8 mm with `certified` and, of second order, 8.8 mm with `fast`; with "
        "steps of 125 ms they reach 19 mm",
        "mm",
    ),
)
"""All checks. The first that fails is the reason, so causes come before their consequences."""


def _uneven(seen: Seen) -> float:
    motion_error = seen.cloth.history.column("motion_error")
    # Motion after the last frame is not shown, and is no fault of the frames.
    if seen.motion_error_end is not None:
        motion_error = np.append(motion_error[:-1], seen.motion_error_end)
    return float(motion_error.max(initial=0.0))


def _unconverged(cloth: Cloth) -> float:
    unconverged = cloth.history.column("unconverged")
    allowed = cloth.preset.unconverged_share_max
    # A preset that allows none has no stretch in which one is allowed.
    if allowed == 0.0:
        return np.inf if unconverged.any() else 0.0
    return worst_stretch(unconverged, np.ones_like(unconverged), 1.0 / allowed) / allowed


def _lift(cloth: Cloth) -> float:
    """Return the work that lifts all cloth by the side of a cell [J]."""
    return float(cloth.masses.sum() * GRAVITY * cloth.mesh.spacing)


def _friction_errors(cloth: Cloth) -> list[float]:
    """Return the relative error of friction with each body, surface and sheet."""
    lift = _lift(cloth)
    friction = np.moveaxis(cloth.history.friction, 1, 0)
    return [worst_stretch(other[:, 1], other[:, 0], lift) for other in friction]


def _sharpest(seen: Seen) -> str:
    errors = _friction_errors(seen.cloth)
    other = int(np.argmax(errors))
    name = seen.others[other] if seen.others else f"number {other} of bodies, surfaces and sheets"
    radius = 1e3 * seen.cloth.mesh.spacing
    # The error grows with the square of the angle of a cell, or faster.
    ratio = math.ceil(20.0 * math.sqrt(errors[other] / FRICTION_ERROR)) / 20.0
    return (
        f"{name} is too sharp for the cells of the cloth: give it edges with a radius of "
        f"{radius:.3g} mm, or a mesh a thickness of {2.0 * radius:.3g} mm; if it is round already, "
        f"make its radius larger, or the cells smaller, by a factor of {ratio:.3g}"
    )


def values(seen: Seen) -> Mapping[str, float]:
    """Return the worst value of each check, by its name."""
    return MappingProxyType({check.name: float(check.value(seen)) for check in CHECKS})


def failed(worst: Mapping[str, float], seen: Seen | None = None) -> tuple[str, str]:
    """Return the code and the text of the first check that fails, or empty texts.

    With `seen`, the text ends with advice where the check has some.
    """
    for check in CHECKS:
        value = worst[check.name]
        # `not value <= limit` is also true for NaN, which `value > limit` would let pass.
        if check.limit is not None and not value <= check.limit:
            unit = "" if check.unit == "1" else f" {check.unit}"
            advice = check.advice(seen) if seen is not None else ""
            return (
                check.name,
                f"{check.name}: must be at most {check.limit:g}{unit}, got {value:.4g} "
                f"({check.formula})" + (f": {advice}" if advice else ""),
            )
    return "", ""


LOOK_AFTER = 100
"""Iterations of Newton's method between two looks of a `Verdict`.

That is half a second for 41 x 41 vertices in contact, and a look takes a millisecond.
"""


class Verdict:
    """Whether a run has failed a check already.

    No judged value becomes better by what follows. So a run that has failed can end at once: it
    stays not valid.
    """

    def __init__(self, cloth: Cloth) -> None:
        self._cloth = cloth
        self._crossings = 0
        self._looked_at = 0
        self.is_lost = False
        """Whether some check has failed."""

    def allows_failure(self) -> bool:
        """Return whether a step that does not converge would leave the run valid."""
        allowed = self._cloth.preset.unconverged_share_max
        if allowed == 0.0:
            return False
        # One is allowed in a stretch of so many steps.
        before = round(1.0 / allowed) - 1
        lately = self._cloth.history.column("unconverged")
        return not lately[max(0, len(lately) - before) :].any()

    def see_step(self) -> bool:
        """Return whether the run is lost after a step, by a look where the last one is long ago."""
        has_failed = self._cloth.history.column("unconverged")[-1:].any()
        if has_failed or self._cloth.total.newton - self._looked_at >= LOOK_AFTER:
            self._look()
        return self.is_lost

    def see_frame(self, crossings: int) -> bool:
        """Return whether the run is lost at a frame with so many pairs of triangles that cross."""
        self._crossings = max(self._crossings, crossings)
        self._look()
        return self.is_lost

    def _look(self) -> None:
        self._looked_at = self._cloth.total.newton
        # The last step may go beyond the last frame, and how bodies move there is no fault.
        seen = Seen(self._cloth, self._cloth.positions[None], self._crossings, motion_error_end=0.0)
        self.is_lost = self.is_lost or bool(failed(values(seen))[0])
