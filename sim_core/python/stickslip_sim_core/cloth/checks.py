"""Checks of a run of cloth: this table alone decides whether the run is valid.

The solver measures every step that it takes. The worst value of each check is stored with the
sample. A run with a value beyond its limit is not valid, and the check is the reason. A value that
is not a number is beyond every limit.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from stickslip_sim_core._sim_core import StepReport
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.presets import STEP_ERROR
from stickslip_sim_core.cloth.solver import Cloth


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
        lambda seen: seen.total.uneven / (seen.cloth.preset.step_error or STEP_ERROR),
        1.0,
        "steps are halved until it is 0.25; where the shortest are not enough, something "
        "jumps or is shaken by 40 g",
    ),
    Check(
        "unconverged",
        "steps that ended above the tolerance, over those that the preset allows",
        lambda seen: _ratio(
            seen.total.unconverged, seen.cloth.preset.unconverged_share_max * seen.total.steps
        ),
        1.0,
        "the preset allows a share of 0.002",
    ),
    Check(
        "budget",
        "most iterations of Newton's method in a second of scene time, over the 50,000 at "
        "which the run ends",
        lambda seen: seen.cloth.spent,
        1.0,
        "where holders, bodies and cloth cannot all have their way, steps take ever more",
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
        "energy: work that bodies do "
        "on the motion against them, with the force R, the gap g at the start and end of the "
        "step, and the slip u",
        lambda seen: _ratio(seen.total.seen.contact_work, seen.total.seen.flow),
        1e-3,
        "contact takes energy from the motion against a body and never gives any; a body that "
        "pushes out what is in it "
        "does",
    ),
    Check(
        "energy_gain",
        "largest energy gained beyond the work of gravity, holders and bodies, over the flow "
        "of energy",
        lambda seen: _ratio(seen.total.seen.gain, seen.total.seen.flow),
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
        "sharpness",
        "side of a cell over the radius of the sharpest edge, ball or rod that bore cloth",
        lambda seen: 1.0 / seen.total.sharpest,
        2.0,
        "cells catch on what has less than half their side as radius",
    ),
    Check(
        "missed",
        "shortest steps that are further off than twice the preset's step error, over those "
        "that fit the scene",
        lambda seen: _ratio(
            seen.total.missed * seen.cloth.preset.longest_step,
            seen.cloth.preset.finest * seen.cloth.time,
        ),
        0.5,
        "drags reach 0, falls 0.13 and tumbles 0.352 with `certified`; a preset too coarse "
        "for its scene reaches 1",
    ),
)
"""All checks. The first that fails is the reason, so causes come before their consequences."""


def _ratio(part: float, whole: float) -> float:
    # A run without a flow of energy, or a preset that allows no unconverged step, has a whole of
    # zero. Any part of it fails every limit, and no part passes.
    return 0.0 if part == 0.0 else part / whole if whole else np.inf


def values(seen: Seen) -> Mapping[str, float]:
    """Return the worst value of each check, by its name."""
    return MappingProxyType({check.name: float(check.value(seen)) for check in CHECKS})


def failed(worst: Mapping[str, float]) -> tuple[str, str]:
    """Return the code and the text of the first check that fails, or empty texts."""
    for check in CHECKS:
        value = worst[check.name]
        # `not value <= limit` is also true for NaN, which `value > limit` would let pass.
        if check.limit is not None and not value <= check.limit:
            unit = "" if check.unit == "1" else f" {check.unit}"
            return (
                check.name,
                f"{check.name}: must be at most {check.limit:g}{unit}, got {value:.4g} "
                f"({check.formula})",
            )
    return "", ""
