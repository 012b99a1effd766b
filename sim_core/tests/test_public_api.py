"""What the package offers, and what it costs to import."""

import subprocess
import sys

import stickslip_sim_core


def test_exported_names() -> None:
    assert set(stickslip_sim_core.__all__) == {
        "Body",
        "BuildInfo",
        "Cloth",
        "ClothRun",
        "Fabric",
        "NaturalCurvature",
        "NaturalFit",
        "OtherMinima",
        "PRESETS",
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
    }


def test_import_needs_numpy_only() -> None:
    code = (
        "import sys, numpy; before = set(sys.modules); import stickslip_sim_core; "
        "names = {m.split('.')[0] for m in set(sys.modules) - before}; "
        "print(sorted(names - set(sys.stdlib_module_names)))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout
    names = set(eval(loaded))
    assert not names & {"scipy", "torch", "ray", "fastapi", "pydantic", "stickslip_schemas"}, names
