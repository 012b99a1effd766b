"""The simulation core of stickslip: hanging rods, in C++ with a thin Python face."""

from stickslip_sim_core._sim_core import BuildInfo, build_info
from stickslip_sim_core.general_rods import solve_general_rods
from stickslip_sim_core.inverse import NaturalCurvature, natural_curvature
from stickslip_sim_core.multistability import OtherMinima, other_minima
from stickslip_sim_core.rod_fit import NaturalFit, ParameterFit, fit_natural_curvature, fit_parameters
from stickslip_sim_core.rod_labels import reach, self_contact_distance
from stickslip_sim_core.rods import RodSolution, solve_rods

__all__ = [
    "BuildInfo",
    "NaturalCurvature",
    "NaturalFit",
    "OtherMinima",
    "ParameterFit",
    "RodSolution",
    "build_info",
    "fit_natural_curvature",
    "fit_parameters",
    "natural_curvature",
    "other_minima",
    "reach",
    "self_contact_distance",
    "solve_general_rods",
    "solve_rods",
]
