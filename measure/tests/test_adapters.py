"""The adapters that come with the package: pinned, short, and right where a simulator is installed.

`STICKSLIP_MEASURE_ENVIRONMENTS` names a folder with an environment for each adapter, such as
`FOLDER/mujoco/bin/python`. Without it, the tests that run a simulator are skipped.
"""

import ast
import io
import os
import re
import tokenize
from pathlib import Path

import numpy as np
import pytest
from stickslip_measure import adapters
from stickslip_measure.campaign import Cell, Request, measure
from stickslip_measure.cli import adapter_names
from stickslip_measure.contract import Floats, Sheet
from stickslip_measure.process import Program
from stickslip_sim_core.cloth import meshes

FOLDER = Path(adapters.__file__).parent
FOREIGN = [name for name in adapter_names() if name != "stickslip"]
ENVIRONMENTS = os.environ.get("STICKSLIP_MEASURE_ENVIRONMENTS")

LONGEST = 90
"""Most lines of code of a file: comments, docstrings and empty lines do not count."""

WITH_SHARED = 127
"""Most of an adapter together with the file that both adapters of Newton share."""

BUDGET = 60.0
"""CPU time of a cell [s]."""

CHEAPEST = {"elastica": "hanging-rod"}
"""The experiment of each adapter that costs least, if it is not the sliding patch."""


def code_lines(path: Path) -> int:
    """Return the number of lines with code: neither comments nor docstrings nor empty ones."""
    text = path.read_text()
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    prose: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, documented) and ast.get_docstring(node) is not None:
            prose |= set(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            code |= set(range(token.start[0], token.end[0] + 1))
    return len(code - prose)


NO_CODE = (
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_an_adapter_is_short(path: Path) -> None:
    lines = code_lines(path)
    assert lines <= LONGEST
    if "from _newton import" in path.read_text():
        assert lines + code_lines(FOLDER / "_newton.py") <= WITH_SHARED


@pytest.mark.parametrize("name", FOREIGN)
def test_requirements_are_pinned(name: str) -> None:
    lines = (FOLDER / f"{name}.requirements.txt").read_text().splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert pins
    assert all(re.fullmatch(r"[a-z-]+==[0-9.]+", pin) for pin in pins)


@pytest.mark.slow
@pytest.mark.parametrize("name", FOREIGN)
def test_the_cheapest_experiment_runs(name: str, tmp_path: Path) -> None:
    if ENVIRONMENTS is None:
        pytest.skip("STICKSLIP_MEASURE_ENVIRONMENTS names no folder of environments")
    python = Path(ENVIRONMENTS) / name / "bin" / "python"
    if not python.exists():
        pytest.skip(f"{name} is not installed: {python} does not exist")
    cells: list[Cell] = []
    experiment = CHEAPEST.get(name, "kinetic-friction")
    program = Program(FOLDER / f"{name}.py", str(python))
    request = Request(program, tmp_path, (experiment,), ("default",), budget=BUDGET)
    measure(request, lambda cell, is_recorded: cells.append(cell))
    coarsest, *finer = (cell for cell in cells if cell.experiment == experiment)
    # Right or wrong, the adapter sets the scene up and steps. Finer meshes may need more time.
    answers = {"measured", "no value", "sleeps"}
    assert coarsest.state in answers, coarsest.reason
    assert {cell.state for cell in finer} <= answers | {"not finished", "not run"}


MESH = meshes.grid(0.1, 0.1, 4, 4)
FLAT = np.column_stack([MESH.rest, np.zeros(len(MESH.rest))])


def sheet(start: Floats) -> Sheet:
    """Return a scene with one sheet of 0.1 x 0.1 m."""
    numbers = np.zeros(len(start), dtype=np.int32)
    return Sheet(MESH.rest, start, MESH.triangles, numbers, 0.025, 0.2, 100.0, 1e-5)


def test_a_sheet_that_is_moved_is_not_curved() -> None:
    turn = np.array([[0.0, -0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, 0.6]])
    assert not sheet(FLAT @ turn.T + 0.3).is_curved()
    bent = FLAT.copy()
    bent[0, 2] += 1e-3
    assert sheet(bent).is_curved()


def test_masses_are_thirds_of_triangles() -> None:
    masses = sheet(FLAT).masses()
    assert masses.sum() == pytest.approx(0.2 * 0.1**2)
    # A vertex at an edge has two triangles, and an inner one up to eight.
    assert masses.max() == pytest.approx(4.0 * masses.min())
