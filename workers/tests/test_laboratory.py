"""Requests of `stickslip lab` become results in JSON."""

import json
from pathlib import Path
from typing import Any

import pytest
from stickslip_workers.__main__ import main
from stickslip_workers.laboratory import run_test

CARD = {"density": 0.2, "stretching": "gray-interlock", "bending": [1e-5, 1e-5, 5e-6]}


def test_a_card_is_tested(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    request = tmp_path / "request.json"
    request.write_text(json.dumps({"test": "cantilever", "name": "linen", "numbers": CARD}))
    assert main(["lab", str(request)]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["warp"]["bending_length_mm"] == pytest.approx(17.21, rel=2e-3)
    assert answer["fabric"] == "linen"


@pytest.mark.parametrize("test", ["tilt", "pull"])
def test_a_built_in_fabric_is_tested(test: str) -> None:
    request: dict[str, Any] = {"test": test, "name": "gray-interlock", "numbers": None, "mu": 0.3}
    assert run_test(request)["read_mu"] == pytest.approx(0.3, rel=0.02)


def test_a_sheet_that_never_slides_has_no_angle() -> None:
    request = {"test": "tilt", "name": "gray-interlock", "numbers": None, "mu": 10.0}
    answer = run_test({**request, "mu": 10.0})
    assert answer["slip_angle_degrees"] == pytest.approx(84.3, abs=0.3)


def test_a_drape_writes_its_picture(tmp_path: Path) -> None:
    numbers = {"density": 0.2, "young": 1e6, "poisson": 0.3, "thickness": 2e-3}
    options = {"cell": 20.0, "seed": 0, "out": str(tmp_path / "out")}
    answer = run_test({"test": "drape", "name": "rubber", "numbers": numbers, **options})
    assert answer["drape_coefficient_percent"] > 90.0
    assert Path(answer["picture"]).read_text().startswith("<svg")
    json.dumps(answer)


def test_a_wrong_number_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    request = tmp_path / "request.json"
    request.write_text(
        json.dumps({"test": "tilt", "name": "gray-interlock", "numbers": None, "mu": 0.0})
    )
    assert main(["lab", str(request)]) == 2
    assert "mu" in capsys.readouterr().err
