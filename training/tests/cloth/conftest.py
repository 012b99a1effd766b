"""Simulations to train and test with; `benchmarks/training/cloth_runs.py` made and packed them."""

from pathlib import Path

import pytest
from stickslip_training.cloth.runs import Runs, load_runs

RUNS = Path(__file__).with_name("runs.npz")


@pytest.fixture(scope="session")
def packed() -> Path:
    """Return the packed file: drop-and-drag of three fabrics at 21 x 21 vertices, in 30 instants."""
    return RUNS


@pytest.fixture(scope="session")
def runs(packed: Path) -> Runs:
    """Return the simulations of the packed file."""
    return load_runs(packed)
