"""The measured numbers: every file of `benchmarks/results/` is complete, and docs/measurements.md
links files.
"""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
RESULTS = sorted((ROOT / "benchmarks" / "results").glob("*.json"))
COMMIT = r"[0-9a-f]{7,40}|studies-\d+"


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_a_result_has_its_origin_and_its_numbers(path: Path) -> None:
    result = json.loads(path.read_text())
    assert result.keys() - {"records"} == {"what", "command", "commit", "conditions", "rows"}
    assert all(
        isinstance(result[key], str) and result[key]
        for key in ("what", "command", "commit", "conditions")
    )
    assert result["rows"]
    for row in result["rows"]:
        assert row.keys() - {"commit"}
        assert re.fullmatch(COMMIT, row.get("commit", result["commit"]))


def test_the_links_of_the_measurements_resolve() -> None:
    text = (ROOT / "docs" / "measurements.md").read_text()
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
        if match := re.search(r"benchmarks/results/\S+", target):
            assert (ROOT / match[0]).exists(), target
        elif "://" not in target:
            assert (ROOT / "docs" / target).exists(), target
