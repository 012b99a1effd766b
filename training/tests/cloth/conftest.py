"""Simulations to train and test with; `benchmarks/training/cloth_runs.py` made and packed them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from stickslip_training.cloth.runs import Runs, load_runs

RUNS = Path(__file__).with_name("runs.npz")


@pytest.fixture(scope="session")
def packed() -> Path:
    """Return the packed file: drop-and-drag of three fabrics, 21 x 21 vertices, 30 instants."""
    return RUNS


@pytest.fixture(scope="session")
def runs(packed: Path) -> Runs:
    """Return the simulations of the packed file."""
    return load_runs(packed)


@pytest.fixture(scope="session")
def split_runs() -> Callable[..., list[Runs]]:
    """Return a function that parts runs into train, validation and test, by shares of the last two
    in every fabric.

    The runs with the least and the largest mu of a fabric are in train: nothing can be learned
    beyond them.
    """

    def split(runs: Runs, *shares: float) -> list[Runs]:
        part = np.zeros(len(runs), dtype=np.int64)
        for code in np.unique(runs.material):
            order = np.flatnonzero(runs.material == code)
            inner = np.random.default_rng((0, int(code))).permutation(
                order[np.argsort(runs.mu[order], kind="stable")][1:-1]
            )
            counts = [round(share * len(order)) for share in shares]
            part[inner[: counts[0]]] = 1
            part[inner[counts[0] : sum(counts)]] = 2
        return [runs[np.flatnonzero(part == number)] for number in range(3)]

    return split
