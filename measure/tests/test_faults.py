"""Faults that are planted in the core are found and named, each by its name alone."""

import os
from collections.abc import Sequence
from pathlib import Path

import pytest
from stickslip_measure.campaign import Cell, Request, measure
from stickslip_measure.diagnosis import findings
from stickslip_measure.process import Program

FAULTY = Path(__file__).with_name("faulty.py")

SLOPES = ("incline-onset", "kinetic-friction")
STRIPS = ("cantilever", "drape")


def cells_of(fault: str, names: Sequence[str], out: Path) -> list[Cell]:
    """Return the cells of the core with a fault."""
    cells: list[Cell] = []
    program = Program(FAULTY, environment={**os.environ, "FAULT": fault})
    measure(
        Request(program, out, names, ("default",), seconds=120.0),
        lambda cell, is_recorded: cells.append(cell),
    )
    return cells


@pytest.mark.physics
@pytest.mark.parametrize(
    ("fault", "names", "named"),
    [
        ("none", ("incline-onset", "kinetic-friction", "creep", "cantilever", "drape"), []),
        ("friction", SLOPES, ["friction is 0.900 times the requested one"]),
        ("bending", STRIPS, ["bending stiffness is 1.200 times the requested one"]),
        ("masses", STRIPS, ["vertex masses are wrong"]),
        ("clamp", ("cantilever",), ["the clamp is not at its place"]),
        ("sleep", SLOPES, ["the simulator sleeps"]),
        ("millimetres", (), ["lengths are in another unit"]),
    ],
)
def test_a_planted_fault_is_named(
    fault: str, names: Sequence[str], named: list[str], tmp_path: Path
) -> None:
    cells = cells_of(fault, names, tmp_path)
    plain = [cell for cell in cells if cell.row == "default"]
    assert [finding.fault for finding in findings(plain)] == named


@pytest.mark.physics
def test_a_calibrated_row_has_the_bending_of_the_others(tmp_path: Path) -> None:
    cells = cells_of("bending", STRIPS, tmp_path)
    (cantilever,) = (
        cell
        for cell in cells
        if (cell.row, cell.experiment, cell.cells)
        == ("default, bending calibrated", "cantilever", 20)
    )
    assert cantilever.value == pytest.approx(1.0, abs=1e-3)
