"""Which files a piece of work is made with, on a package made for the purpose."""

import sys
from pathlib import Path

import pytest
from stickslip_schemas.plan.builds import digests, sources

PACKAGE = {
    "__init__.py": (
        "from stickslip_made.deep.tool import saw\nfrom stickslip_made.other import file\n"
    ),
    "work.py": """
from typing import TYPE_CHECKING
from stickslip_made import saw
if TYPE_CHECKING:
    from stickslip_made.typed import Only
def run():
    from stickslip_made.late import late
    return late, "table.toml"
""",
    "typed.py": "",
    "late.py": "import stickslip_made.deep.same\n",
    "other.py": "",
    "same.py": "",
    "table.toml": "",
    "not_named.toml": "",
    "registry.py": "from stickslip_made import other\n",
    "asks.py": "from stickslip_made import registry\n",
    "lost.py": "from stickslip_made.gone import x\n",
    "deep/__init__.py": "",
    "deep/tool.py": "saw = 1\n",
    "deep/same.py": "from stickslip_made import same\n",
}


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, text in PACKAGE.items():
        path = tmp_path / "stickslip_made" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path / "stickslip_made"


def test_imports_are_followed_wherever_they_stand(tree: Path) -> None:
    assert set(sources(["stickslip_made.work"])) == {
        "stickslip_made/work.py",
        "stickslip_made/table.toml",  # named in a string
        "stickslip_made/deep/tool.py",  # through the package that only passes it on
        "stickslip_made/late.py",  # inside a function
        "stickslip_made/deep/same.py",
        "stickslip_made/same.py",  # of the same file name: both count
    }
    assert "stickslip_made" not in sys.modules  # nothing is run


def test_every_change_changes_the_digests_and_no_other(tree: Path) -> None:
    before = digests(sources(["stickslip_made.work"]))
    for name, path in sources(["stickslip_made.work"]).items():
        text = path.read_text()
        path.write_text(text + "# changed\n")
        after = digests(sources(["stickslip_made.work"]))
        assert {key for key in before if before[key] != after[key]} == {name}
        path.write_text(text)
    for name in ("typed.py", "other.py", "not_named.toml"):
        (tree / name).write_text("# changed\n")
    assert digests(sources(["stickslip_made.work"])) == before


def test_what_is_cut_is_not_followed(tree: Path) -> None:
    assert "stickslip_made/other.py" in sources(["stickslip_made.asks"])
    assert set(sources(["stickslip_made.asks"], cut=("stickslip_made.registry",))) == {
        "stickslip_made/asks.py"
    }
    assert set(
        sources(["stickslip_made.work"], cut=("stickslip_made.deep.*", "stickslip_made.late"))
    ) == {
        "stickslip_made/work.py",
        "stickslip_made/table.toml",
    }


def test_a_module_that_is_missing_is_named(tree: Path) -> None:
    with pytest.raises(ModuleNotFoundError, match=r"no source of module stickslip_made\.gone"):
        sources(["stickslip_made.lost"])
