"""`stickslip rods measure`: what its command line refuses, and what it prints."""

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from stickslip_services.cli.rods import rods
from stickslip_services.local import making


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        ([], 2, "Missing option '--ledge'"),
        (["--ledge", "12"], 2, "must be 2 numbers with commas, and is '12'"),
        (["--ledge", "1,2", "--ruler", "1,2,a,4"], 2, "must be 4 numbers with commas"),
        (["--ledge", "1,2", "--mark-mm", "0"], 2, "must be a number of millimetres, 0.1 or more"),
        (["--ledge", "1,2"], 1, "there is no file"),
        (["--ledge", "1,2"] * 3, 1, "--ledge: must be given once, or once for each of 2"),
    ],
)
def test_wrong_command_lines_are_refused(
    options: list[str], status: int, message: str, tmp_path: Path
) -> None:
    photographs = [str(tmp_path / "a.jpg"), str(tmp_path / "b.jpg")]
    result = CliRunner().invoke(rods, ["measure", *photographs, *options])
    assert result.exit_code == status
    assert message in " ".join(result.output.split())


def test_results_are_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    photograph = {
        "photograph": "yarn/a.jpg",
        "length_mm": 150.04,
        "bending_length_mm": 20.06,
        "bending_length_error_mm": 1.52,
        "natural_bend_per_m": -3.0,
        "natural_bend_error_per_m": 0.4,
        "clamp_degrees": -8.0,
        "clamp_error_degrees": 1.0,
        "trades_bend_for_weight": True,
        "picture": "out/a-bending.png",
    }
    joint = {"bending_length": 20.06, "error": 1.07, "scatter": 0.0}
    requests: list[Any] = []

    def measure(request: Any) -> Any:
        requests.append(request)
        return {"photographs": [photograph, photograph], "joint": joint}

    monkeypatch.setattr(making, "measure_photographs", measure)
    words = ["measure", "a.jpg", "b.jpg", "--ledge", "3,4", "--ruler", "1,2,3,4"]
    result = CliRunner().invoke(rods, words)
    assert result.exit_code == 0
    assert "20.1 +- 1.5" in result.output
    assert "-3.0 +- 0.4" in result.output
    assert "a stiffer thread of another natural bend would hang alike" in result.output
    assert "one yarn: bending length 20.1 +- 1.1 mm" in " ".join(result.output.split())
    # A pixel that is given once is that of all photographs.
    assert requests[0]["ledges"] == [[3.0, 4.0], [3.0, 4.0]]
    assert requests[0]["rulers"] == [[1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0, 4.0]]
