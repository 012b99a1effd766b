"""What the package offers, and what it costs to import."""

import subprocess
import sys

import stickslip_sim_core


def test_exported_names() -> None:
    assert set(stickslip_sim_core.__all__) == {
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
    }


def test_import_needs_numpy_only() -> None:
    code = (
        "import sys, numpy; before = set(sys.modules); import stickslip_sim_core; "
        "print(sorted({m.split('.')[0] for m in set(sys.modules) - before} - set(sys.stdlib_module_names)))"
    )
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    names = set(eval(loaded))
    assert not names & {"scipy", "torch", "ray", "fastapi", "pydantic", "stickslip_schemas"}, names
