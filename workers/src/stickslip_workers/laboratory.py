"""Tests of the textile laboratory on a card, for `stickslip lab`."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from stickslip_sim_core.cloth.fabrics import Fabric, fabric, fabric_of_card
from stickslip_sim_core.lab.cantilever import BendingLength, cantilever
from stickslip_sim_core.lab.drape import drape
from stickslip_sim_core.lab.picture import drape_svg
from stickslip_sim_core.lab.pull import pull
from stickslip_sim_core.lab.tilt import tilt

PICTURE_NAME = "drape.svg"

Answer = dict[str, Any]
Test = Callable[[Fabric, Mapping[str, Any]], Answer]


def run_test(request: Mapping[str, Any]) -> Answer:
    """Run a test of a request of `stickslip lab`, and return its result as JSON.

    The request has `test`, `name` and `numbers` of the fabric, null for a built-in one, and the
    options of the test.

    Raises:
        ValueError: A value breaks its rule, or the test has no result.
    """
    numbers = request["numbers"]
    name = request["name"]
    tested = fabric(name) if numbers is None else fabric_of_card(name, numbers)
    return {"test": request["test"], "fabric": name, **TESTS[request["test"]](tested, request)}


def _drape(tested: Fabric, request: Mapping[str, Any]) -> Answer:
    draped = drape(tested, cell=1e-3 * request["cell"], seed=request["seed"])
    out = Path(request["out"])
    out.mkdir(parents=True, exist_ok=True)
    (out / PICTURE_NAME).write_text(drape_svg(draped), encoding="utf-8")
    return {
        "drape_coefficient_percent": round(draped.coefficient, 2),
        "folds": draped.folds,
        "rim_drop_mm": [round(1e3 * drop, 1) for drop in draped.drop],
        "cell_mm": 1e3 * draped.cell,
        "vertices": len(draped.positions),
        "at_rest": draped.at_rest,
        "unconverged_steps": draped.unconverged,
        "picture": str(out / PICTURE_NAME),
    }


def _cantilever(tested: Fabric, _request: Mapping[str, Any]) -> Answer:
    return {
        "warp": _bending_length(cantilever(tested, "warp")),
        "weft": _bending_length(cantilever(tested, "weft")),
    }


def _bending_length(measured: BendingLength) -> Answer:
    return {
        "overhang_mm": round(1e3 * measured.overhang, 2),
        "bending_length_mm": round(1e3 * measured.bending_length, 2),
        "rigidity": float(f"{measured.rigidity:.4g}"),
        "rigidity_of_the_card": measured.stated_rigidity,
    }


def _tilt(tested: Fabric, request: Mapping[str, Any]) -> Answer:
    slipped = tilt(tested, request["mu"])
    # JSON has no NaN: a sheet that does not slide has no angle.
    slides = bool(np.isfinite(slipped.angle))
    return {
        "mu": slipped.mu,
        "slip_angle_degrees": round(float(np.degrees(slipped.angle)), 2) if slides else None,
        "read_mu": round(slipped.read_mu, 4) if slides else None,
    }


def _pull(tested: Fabric, request: Mapping[str, Any]) -> Answer:
    pulled = pull(tested, request["mu"])
    return {
        "mu": pulled.mu,
        "light_pull_n_per_m": pulled.light,
        "heavy_pull_n_per_m": round(pulled.heavy, 5),
        "wrap_degrees": round(float(np.degrees(pulled.wrap)), 2),
        "read_mu": round(pulled.read_mu, 4),
    }


TESTS: Mapping[str, Test] = MappingProxyType(
    {"drape": _drape, "cantilever": _cantilever, "tilt": _tilt, "pull": _pull}
)
"""Tests by name."""
