"""Cloth: fabrics, meshes, contact, and the solver."""

from stickslip_sim_core.cloth.bodies import Body, box, plane, sphere
from stickslip_sim_core.cloth.contact import PairForces, SelfContact
from stickslip_sim_core.cloth.fabrics import Fabric, custom_fabric, fabric, fabric_names, isotropic
from stickslip_sim_core.cloth.presets import PRESETS, SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import Cloth

__all__ = [
    "PRESETS",
    "Body",
    "Cloth",
    "Fabric",
    "PairForces",
    "SelfContact",
    "SolverSettings",
    "box",
    "fabric",
    "fabric_names",
    "isotropic",
    "custom_fabric",
    "plane",
    "preset_named",
    "sphere",
]
