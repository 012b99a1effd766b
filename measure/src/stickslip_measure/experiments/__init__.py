"""The twelve experiments, and the checks before them."""

from stickslip_measure.experiments import capstan, cards, checks, drape, rods, slopes, strips
from stickslip_measure.laboratory import Experiment

CHECKS: dict[str, Experiment] = {check.name: check for check in checks.CHECKS}

_ORDER = (
    "incline-onset",
    "kinetic-friction",
    "creep",
    "stacked-incline",
    "capstan",
    "pull-out",
    "house-of-cards",
    "pinch",
    "cantilever",
    "lateral-buckling",
    "drape",
    "hanging-rod",
)
_MODULES = (slopes, capstan, cards, strips, drape, rods)

_BY_NAME = {experiment.name: experiment for module in _MODULES for experiment in module.EXPERIMENTS}

EXPERIMENTS: dict[str, Experiment] = {name: _BY_NAME[name] for name in _ORDER}

FRICTION = _ORDER[:2] + _ORDER[3:8]
"""Experiments whose value is proportional to friction."""

MOTION = ("incline-onset", "kinetic-friction", "stacked-incline", "capstan", "pull-out")
"""Experiments whose value follows from a speed or an acceleration, and so from the time."""

BENDING = ("cantilever", "lateral-buckling", "drape")
"""Experiments whose value is proportional to bending stiffness."""


def experiment_named(name: str) -> Experiment:
    """Return an experiment or a check by its name."""
    return CHECKS[name] if name in CHECKS else EXPERIMENTS[name]
