"""Master curves: the values that physics predicts for the protocols.

They are computed and never tabulated. Each curve has a module:

    cantilever            drop over reach of a strip that is clamped horizontally
    lateral_buckling      weight at which a strip that is clamped edge-on buckles
    stick_slip            friction at which the tip of a pressed strip slips
    bend_twist            weight below which a curly rod leaves its plane
    capstan               ratio of the pulls on a strip over a cylinder
    heavy_fold            shape of a strip that is folded onto itself

Curves of rods and strips are solved to 1e-9 (boundary_values.py), and the curve of a plate to 5e-5
(plate_buckling.py). They share no code with the measured solvers, so a protocol compares two
independent computations. docs/protocols.md has symbols, definitions and figures.
"""

from stickslip_sim_core.reference.bend_twist import bend_twist, bend_twist_onset
from stickslip_sim_core.reference.boundary_values import NotSolvedError
from stickslip_sim_core.reference.cantilever import cantilever
from stickslip_sim_core.reference.capstan import capstan
from stickslip_sim_core.reference.heavy_fold import HeavyFold, heavy_fold
from stickslip_sim_core.reference.lateral_buckling import lateral_buckling, lateral_buckling_rod
from stickslip_sim_core.reference.stick_slip import (
    stick_slip,
    stick_slip_strain,
    stick_slip_triple_point,
)

__all__ = [
    "HeavyFold",
    "NotSolvedError",
    "bend_twist",
    "bend_twist_onset",
    "cantilever",
    "capstan",
    "heavy_fold",
    "lateral_buckling",
    "lateral_buckling_rod",
    "stick_slip",
    "stick_slip_strain",
    "stick_slip_triple_point",
]
