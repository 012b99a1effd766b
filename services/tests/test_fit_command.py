"""`stickslip fit`: what its command line refuses before anything runs."""

from pathlib import Path

import pytest
from click.testing import CliRunner
from stickslip_services.cli.fitting import fit


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--start", "mu"], "--start: must be NAME=NUMBER"),
        (["--start", "mu=a"], "--start: must be NAME=NUMBER"),
        ([], "there is no file"),
    ],
)
def test_wrong_command_lines_are_refused(options: list[str], message: str, tmp_path: Path) -> None:
    words = ["peg", str(tmp_path / "seen.npz"), "--parameters", "mu", *options]
    result = CliRunner().invoke(fit, words)
    assert result.exit_code == 1
    assert message in result.output
