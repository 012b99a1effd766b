"""The simulation core of stickslip: hanging rods, in C++ with a thin Python face."""

from stickslip_sim_core._sim_core import BuildInfo, build_info
from stickslip_sim_core.rods import RodSolution, solve_rods

__all__ = ["BuildInfo", "RodSolution", "build_info", "solve_rods"]
