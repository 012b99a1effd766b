"""The notebook runs as it is written."""

import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.mark.slow
def test_the_notebook_runs() -> None:
    pytest.importorskip("matplotlib")
    notebook = HERE.parent / "notebooks" / "first_steps.ipynb"
    command = [sys.executable, str(HERE / "run_notebook.py"), str(notebook)]
    subprocess.run(command, check=True, timeout=300, cwd=HERE)
