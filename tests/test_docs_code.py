"""Every code block of README.md and of the documentation site runs as it is printed.

Python blocks of a page run one after the other in one namespace, and so do shell blocks, whose
variables live on. They run in a fresh directory with `examples/`. YAML blocks are specs or scenes:
they are checked, and written to the file that their first line names. The output of `print(...)`
must be that of the comment after it. The service is a real one.
A block after `<!-- skip: REASON -->` is not run.
"""

import io
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from harness import STICKSLIP, Service
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.scene.document import Scene

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
RUN_ELSEWHERE = {"from-four-pngs.md"}  # test_docs.py runs it, and looks at what comes out
LONG = {
    "README.md",
    "benchmark.md",
}  # clips of two simulations, 245 rods; the tutorials make smaller datasets
# deploy/, PostgreSQL and S3 need other machines; test_deploy.py checks commands of the first
MOST_SKIPPED = 30

_RUN = ("python", "sh", "yaml")
_FENCE = re.compile(
    r"(?:<!-- skip: (?P<reason>.+?) -->\n)?^```(?P<language>\S*)\n(?P<code>.*?)^```$", re.M | re.S
)


@dataclass(frozen=True)
class Block:
    """A block of code, and where it stands."""

    language: str
    code: str
    line: int
    reason: str | None


def blocks(page: Path) -> list[Block]:
    text = page.read_text()
    return [
        Block(
            match["language"],
            match["code"],
            text.count("\n", 0, match.start("code")),
            match["reason"],
        )
        for match in _FENCE.finditer(text)
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_block_says_what_it_is(page: Path) -> None:
    for block in blocks(page):
        assert block.language.startswith("{") or block.language in (
            "python",
            "sh",
            "yaml",
            "ini",
            "text",
        ), block
        assert block.reason is None or len(block.reason) > 20, block
    outside = _FENCE.sub("", page.read_text())
    assert "```" not in outside
    assert not re.search(r"^\n {4}[a-z]+[.(]", outside, re.M), (
        "an indented block of code: nobody runs it"
    )


def runner_of(block: Block) -> Path | None:
    """Return the test that runs a block in a place of its own; None if no test does."""
    named = re.search(r"((?:services/)?tests/\w+\.py) runs it", block.reason or "")
    return None if named is None else ROOT / named[1]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_that_run_elsewhere_name_a_test(page: Path) -> None:
    for block in blocks(page):
        runner = runner_of(block)
        assert runner is None or runner.exists(), (page.name, block)


def test_few_blocks_are_not_run() -> None:
    skipped = [
        (page.name, block.line, block.reason)
        for page in PAGES
        for block in blocks(page)
        if block.reason and runner_of(block) is None
    ]
    assert len(skipped) <= MOST_SKIPPED, skipped


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A directory to run a page in."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    shutil.rmtree(tmp_path, ignore_errors=True)


@pytest.mark.timeout(1200)
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.name, marks=pytest.mark.slow if page.name in LONG else ())
        for page in PAGES
        if page.name not in RUN_ELSEWHERE and any(b.language in _RUN for b in blocks(page))
    ],
)
def test_every_block_runs(
    page: Path, service: Service, place: Path, monkeypatch: pytest.MonkeyPatch, rods: Path
) -> None:
    monkeypatch.setenv("STICKSLIP_URL", service.url)
    monkeypatch.setenv("PATH", f"{STICKSLIP.parent}:{os.environ['PATH']}")
    if page.name == "dataset.md":
        shutil.copytree(rods, place / "my-rods")
    names: dict[str, Any] = {"__name__": page.stem}
    state = place / ".state"
    state.write_text("")
    for block in blocks(page):
        if block.reason is not None:
            continue
        where = f"{page.name}, line {block.line + 1}"
        if block.language == "python":
            printed = io.StringIO()
            with redirect_stdout(printed):
                exec(compile("\n" * block.line + block.code, str(page), "exec"), names)
            for promised in re.findall(r"print\(.*\)  # (.+)", block.code):
                start = promised.removesuffix(" ...")
                assert any(line.startswith(start) for line in printed.getvalue().splitlines()), (
                    where,
                    promised,
                )
        elif block.language == "sh":
            script = (
                f"set -euo pipefail; source {state}; set -a\n{block.code}\nexport -p > {state}\n"
            )
            done = subprocess.run(["bash", "-c", script], capture_output=True, text=True)
            assert done.returncode == 0, f"{where}:\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
        elif block.language == "yaml":
            document = yaml.safe_load(block.code)
            if "format" in document:
                Scene.model_validate(document)
            else:
                job_spec_adapter.validate_python(document)
            if name := re.match(r"# (\S+\.yaml)\n", block.code):
                (place / name[1]).write_text(block.code)


@pytest.fixture(scope="module")
def rods(service: Service, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of four rods, pulled."""
    axes = {"gamma": [300, 900], "phi0": 0.2, "phi1": [6, 12]}
    job = service.finished(service.submit({"kind": "rod_hang", "axes": axes, "quality": "draft"}))
    target = tmp_path_factory.mktemp("rods") / "my-rods"
    name = f"{job['dataset']['dataset']}:v1"
    subprocess.run([STICKSLIP, "pull", name, target, "--url", service.url], check=True)
    return target


def test_the_code_of_a_dataset_card_runs(rods: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(rods)
    names: dict[str, Any] = {}
    for block in blocks(rods / "README.md"):
        if block.language == "python":
            exec(block.code, names)
    assert names["sample"].shape == (4, 224, 224, 3)
    assert names["train"].reader.kind == "rod_hang"


def test_the_reference_of_specs_is_up_to_date() -> None:
    result = subprocess.run(
        [sys.executable, ROOT / "tools/spec_reference.py"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout == (ROOT / "docs/spec.md").read_text(), (
        "run: python tools/spec_reference.py > docs/spec.md"
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason="make setup-dev")
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-W",
        "--keep-going",
        "-q",
        "-b",
        "html",
        "docs",
        str(tmp_path / "site"),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    pages = {page.stem for page in (tmp_path / "site").glob("*.html")}
    assert {page.stem for page in PAGES[1:]} <= pages
