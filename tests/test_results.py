"""Every file of `benchmarks/results/` is complete, and docs/measurements.md links files."""

import json
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
RESULTS = sorted((ROOT / "benchmarks" / "results").glob("*.json"))
COMMIT = r"[0-9a-f]{7,40}"


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


def test_every_commit_of_a_record_is_in_the_history() -> None:
    if not is_whole_history():
        pytest.skip("this checkout has no history, or only a part of it")
    commits = set()
    for path in RESULTS:
        commits |= set(re.findall(r'"commit": "([^"]+)"', path.read_text()))
        commits |= set(re.findall(r"at commit ([0-9a-f]{7,40})", path.read_text()))
    assert len(commits) > 50
    names = "".join(f"{commit}^{{commit}}\n" for commit in sorted(commits))
    checked = git("cat-file", "--batch-check", stdin=names)
    assert [line for line in checked.splitlines() if line.endswith("missing")] == []


def git(*arguments: str, stdin: str = "") -> str:
    """Return the output of a git command in the repository."""
    command = ["git", *arguments]
    done = subprocess.run(command, cwd=ROOT, input=stdin, capture_output=True, text=True)
    return done.stdout.strip()


def is_whole_history() -> bool:
    """Return whether this is a clone with all commits."""
    return git("rev-parse", "--is-shallow-repository") == "false"


def test_the_links_of_the_measurements_resolve() -> None:
    text = (ROOT / "docs" / "measurements.md").read_text()
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
        if match := re.search(r"benchmarks/results/\S+", target):
            assert (ROOT / match[0]).exists(), target
        elif "://" not in target:
            assert (ROOT / "docs" / target).exists(), target
