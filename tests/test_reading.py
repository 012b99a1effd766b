"""The page that guides through the code names files that exist."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = ("docs/reading-the-code.md", "docs/architecture.md", "docs/adding-a-kind.md")


@pytest.mark.parametrize("page", PAGES)
def test_paths_of_the_code_exist(page: str) -> None:
    text = (ROOT / page).read_text()
    paths = re.findall(r"`((?:schemas|services|sim_core|training|workers)/[\w./-]+)`", text)
    missing = [path for path in paths if not (ROOT / path).exists()]
    assert missing == []
    if page.endswith("reading-the-code.md"):
        assert len(paths) > 25
