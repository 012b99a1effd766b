"""The simulation core of stickslip: hanging rods and sliding cloth.

The solvers are C++ with a thin Python layer.
"""

from stickslip_sim_core._sim_core import BuildInfo, PairForces, build_info, self_intersections
from stickslip_sim_core.cloth.contact import (
    Body,
    SelfContact,
    Surface,
    box,
    capsule,
    cylinder,
    plane,
    sphere,
)
from stickslip_sim_core.cloth.fabrics import Fabric, custom_fabric, fabric, fabric_names, isotropic
from stickslip_sim_core.cloth.presets import PRESETS, SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.rods.fit import (
    NaturalFit,
    ParameterFit,
    fit_natural_curvature,
    fit_parameters,
)
from stickslip_sim_core.rods.inverse import NaturalCurvature, natural_curvature
from stickslip_sim_core.rods.labels import OtherMinima, other_minima, reach, self_contact_distance
from stickslip_sim_core.rods.solve import RodSolution, solve_general_rods, solve_rods
from stickslip_sim_core.rods.tilt import TiltedFit, fit_tilted_clamp
from stickslip_sim_core.scenes.scene import ClothRun, Scene

__all__ = [
    "PRESETS",
    "Body",
    "BuildInfo",
    "Cloth",
    "ClothRun",
    "Fabric",
    "NaturalCurvature",
    "NaturalFit",
    "OtherMinima",
    "PairForces",
    "ParameterFit",
    "RodSolution",
    "Scene",
    "SelfContact",
    "SolverSettings",
    "Surface",
    "TiltedFit",
    "box",
    "capsule",
    "build_info",
    "cylinder",
    "fabric",
    "fabric_names",
    "fit_natural_curvature",
    "fit_parameters",
    "fit_tilted_clamp",
    "isotropic",
    "natural_curvature",
    "other_minima",
    "custom_fabric",
    "plane",
    "preset_named",
    "reach",
    "self_contact_distance",
    "self_intersections",
    "solve_general_rods",
    "solve_rods",
    "sphere",
]
