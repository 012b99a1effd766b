"""The committed stub is what nanobind writes for the built module."""

import subprocess
import sys
from pathlib import Path

import pytest

import stickslip_sim_core


def test_stub_is_current(tmp_path: Path) -> None:
    pytest.importorskip("nanobind")
    fresh = tmp_path / "_sim_core.pyi"
    command = [sys.executable, "-m", "nanobind.stubgen", "-m", "stickslip_sim_core._sim_core", "-o", str(fresh)]
    subprocess.run(command, check=True, capture_output=True)
    committed = Path(stickslip_sim_core.__file__).with_name("_sim_core.pyi")
    assert committed.read_text() == fresh.read_text()
