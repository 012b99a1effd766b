"""Check prose: Markdown with proselint, and Markdown and sources against docs/bad-phrases.txt.

python tools/prose.py [FILE ...]     without files: all that git tracks
"""

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from proselint.checks import __register__
from proselint.registry import CheckRegistry
from proselint.tools import LintFile

ROOT = Path(__file__).parents[1]
PHRASES = ROOT / "docs" / "bad-phrases.txt"
SUFFIXES = ("md", "py", "pyi", "cpp", "hpp", "html", "js", "yaml", "toml")
CHECKS = (
    "archaism",
    "cliches",
    "hedging",
    "industrial_language",
    "nonwords",
    "oxymorons",
    "redundancy",
    "weasel_words",
)
"""Of proselint. Its rules of typography ask for curly quotes, which code does not have."""


def phrases() -> tuple[re.Pattern[str], list[str]]:
    """Return one expression with a group for each bad phrase, and what to write instead of each."""
    lines = [line for line in PHRASES.read_text().splitlines() if line and not line.startswith("#")]
    pairs = [line.split(" -> ", 1) for line in lines]
    groups = (bad.replace("(", "(?:").replace(" ", r"[\s#/*]+") for bad, _ in pairs)
    return re.compile("|".join(rf"(\b(?:{group})\b)" for group in groups), re.IGNORECASE), [
        good for _, good in pairs
    ]


def complaints(path: Path, bad: re.Pattern[str], instead: list[str]) -> Iterator[str]:
    """Yield a line for each bad phrase of a file, and for each complaint of proselint."""
    text = path.read_text()
    if path.suffix == ".md":
        text = re.sub(r"^```.*?^```|`[^`\n]*`", _blank, text, flags=re.DOTALL | re.MULTILINE)
        for result in LintFile(str(path), text).lint(
            {"max_errors": 100, "checks": dict.fromkeys(CHECKS, True)}
        ):
            yield f"{path.relative_to(ROOT)}:{result.pos[0]}: {result.check_result.message}"
    for match in bad.finditer(text):
        line = 1 + text.count("\n", 0, match.start())
        phrase = " ".join(match[0].split())
        replacement = instead[(match.lastindex or 1) - 1]
        yield f"{path.relative_to(ROOT)}:{line}: {phrase!r}: write instead: {replacement}"


def _blank(match: re.Match[str]) -> str:
    return re.sub(r"[^\n]", " ", match[0])


def main(arguments: list[str]) -> int:
    """Print every complaint; return 1 if there is one."""
    CheckRegistry().register_many(__register__)
    command = ["git", "ls-files", *(f"*.{suffix}" for suffix in SUFFIXES)]
    tracked = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split("\n")
    paths = [ROOT / name for name in arguments or tracked if name and name != "tools/prose.py"]
    bad, instead = phrases()
    faults: list[str] = []
    for path in paths:
        if path.exists():
            faults += complaints(path, bad, instead)
    sys.stdout.write("".join(f"{line}\n" for line in faults))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
