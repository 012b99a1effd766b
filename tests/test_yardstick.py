"""docs/yardstick.md and its page say what the record of the five simulators has."""

import json
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from stickslip_measure import experiments
from stickslip_measure.page import overview, rows_of

ROOT = Path(__file__).parents[1]


def loaded(name: str) -> ModuleType:
    """Return a script of the folder `benchmarks`."""
    spec = spec_from_file_location(name, ROOT / f"benchmarks/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def script() -> ModuleType:
    """The script that writes page and guide."""
    return loaded("yardstick")


@pytest.fixture(scope="module")
def record(script: ModuleType) -> Any:
    """The record."""
    return json.loads(script.RECORD.read_text())


def test_the_guide_has_the_numbers_of_the_record(script: ModuleType, record: Any) -> None:
    guide = script.GUIDE.read_text()
    assert script.completed(guide, record) == guide


def test_the_page_has_the_numbers_of_the_record(script: ModuleType, record: Any) -> None:
    assert overview(rows_of(script.cells_of(record))) in script.PAGE.read_text()


def test_the_guide_has_the_scenes_of_the_experiments() -> None:
    scenes = loaded("yardstick_scenes")
    guide = scenes.GUIDE.read_text()
    assert scenes.completed(guide) == guide


def test_every_experiment_was_attempted_on_every_simulator(script: ModuleType, record: Any) -> None:
    cells = script.cells_of(record)
    simulators = {cell.simulator for cell in cells}
    assert simulators == set(script.ORDER)
    for simulator in simulators:
        for name, experiment in experiments.EXPERIMENTS.items():
            coarsest = [
                cell
                for cell in cells
                if (cell.simulator, cell.experiment, cell.cells)
                == (simulator, name, experiment.cells[0])
            ]
            assert coarsest, (simulator, name)
            # A reason says why there is no number, and "not run" is none for the coarsest mesh.
            for cell in coarsest:
                assert cell.state == "measured" or cell.reason, cell
                assert cell.state != "not run", cell


def test_an_entry_in_brackets_is_a_coarser_one(script: ModuleType) -> None:
    experiment = experiments.EXPERIMENTS["creep"]
    facts = ("toy", "1", "default", "creep")
    coarse = script.Cell(*facts, 5, "measured", "", 0.25, 0.0, 1.0, "")
    slow = script.Cell(*facts, 10, "not finished", "60 s", None, None, 60.0, "")
    assert script.entry([coarse, slow], experiment) == "(0.25)"
    assert script.entry([slow], experiment) == "not finished"
    middle = script.Cell(*facts, 10, "measured", "", 0.125, 0.0, 1.0, "")
    assert script.entry([coarse, middle], experiment) == "0.125"
    assert script.entry([], experiment) == "not attempted"
