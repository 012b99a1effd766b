"""The simulation core of stickslip: hanging rods, in C++ with a thin Python face."""

from stickslip_sim_core._sim_core import BuildInfo, build_info
from stickslip_sim_core.general_rods import solve_general_rods
from stickslip_sim_core.multistability import OtherMinima, other_minima
from stickslip_sim_core.rod_labels import reach, self_contact_distance
from stickslip_sim_core.rods import RodSolution, solve_rods

__all__ = [
    "BuildInfo",
    "OtherMinima",
    "RodSolution",
    "build_info",
    "other_minima",
    "reach",
    "self_contact_distance",
    "solve_general_rods",
    "solve_rods",
]
