"""The simulation core of stickslip: hanging rods and sliding cloth, in C++ with a thin Python face."""

from stickslip_sim_core._sim_core import BuildInfo, build_info, self_intersections
from stickslip_sim_core.cloth import Body, Cloth, box, plane, sphere
from stickslip_sim_core.fabrics import Fabric, fabric, fabric_names, isotropic
from stickslip_sim_core.general_rods import solve_general_rods
from stickslip_sim_core.inverse import NaturalCurvature, natural_curvature
from stickslip_sim_core.multistability import OtherMinima, other_minima
from stickslip_sim_core.presets import PRESETS, Preset, preset_named
from stickslip_sim_core.rod_fit import NaturalFit, ParameterFit, fit_natural_curvature, fit_parameters
from stickslip_sim_core.rod_labels import reach, self_contact_distance
from stickslip_sim_core.rods import RodSolution, solve_rods
from stickslip_sim_core.scenes import DropAndDrag, drop_and_drag

__all__ = [
    "PRESETS",
    "Body",
    "BuildInfo",
    "Cloth",
    "DropAndDrag",
    "Fabric",
    "NaturalCurvature",
    "NaturalFit",
    "OtherMinima",
    "ParameterFit",
    "Preset",
    "RodSolution",
    "box",
    "build_info",
    "drop_and_drag",
    "fabric",
    "fabric_names",
    "fit_natural_curvature",
    "fit_parameters",
    "isotropic",
    "natural_curvature",
    "other_minima",
    "plane",
    "preset_named",
    "reach",
    "self_contact_distance",
    "self_intersections",
    "solve_general_rods",
    "solve_rods",
    "sphere",
]
