"""The examples of the documentation: their code runs as it is printed, and does what the text
around it says.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]


def run_code(page: Path, names: dict[str, Any]) -> dict[str, Any]:
    """Run the Python of a Markdown page, block after block, in one namespace; return it."""
    text = page.read_text()
    blocks = [
        (match.start(1), match.group(1))
        for match in re.finditer(r"```python\n(.*?)```", text, re.DOTALL)
    ]
    assert blocks, f"{page} has no code"
    for start, block in blocks:
        before = text.count("\n", 0, start)  # so that a traceback names the line of the page
        exec(compile("\n" * before + block, str(page), "exec"), names)
    return names


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("four-pngs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        return run_code(ROOT / "docs" / "from-four-pngs.md", {"out": out})


def test_the_pictures_give_the_centreline(example: dict[str, Any]) -> None:
    from stickslip_sim_core import solve_general_rods

    fit = example["found"]
    assert fit.verdict == "good"
    s = np.linspace(0.0, 1.0, 150)
    truth = solve_general_rods(
        np.stack([3 + 0 * s, 0 * s, 6 + 10 * s], axis=1)[None], [300.0]
    ).centerline[0]
    assert np.linalg.norm(fit.centerline - truth, axis=1).mean() < 1e-3


def test_the_fit_gives_the_natural_shape(example: dict[str, Any]) -> None:
    truth = 6 + 10 * example["s"]
    assert np.sqrt(np.mean((example["curl"] - truth) ** 2) / np.mean(truth**2)) < 0.05
    assert example["uniform"].residual > 30 * example["fit"].residual
    assert example["miss"].mean() < 1e-3


def test_the_page_shows_what_the_code_draws(example: dict[str, Any]) -> None:
    from PIL import Image

    for name in ("centerline.png", "natural.png"):
        with (
            Image.open(example["out"] / name) as drawn,
            Image.open(ROOT / "docs/figures/from-four-pngs" / name) as published,
        ):
            assert drawn.size == published.size
