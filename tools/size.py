"""Count the lines of source, and fail if a file is longer than a reader can keep in mind.

Source is what git tracks of .py .pyi .cpp .hpp .html .js .css in the distributions, without tests.
A code line is neither empty nor only a comment, and it does not belong to a docstring. There is no
limit on the total: a limit makes the code dense. `make density` measures how dense the code is.
"""

import ast
import subprocess
import sys
from pathlib import Path

FOLDERS = (
    "schemas/src",
    "services/src",
    "workers",
    "training/src",
    "measure/src",
    "sim_core/src",
    "sim_core/python",
)
ENDINGS = (".py", ".pyi", ".cpp", ".hpp", ".html", ".js", ".css")

MAX_CODE_LINES = {".py": 400, ".cpp": 300, ".hpp": 300}


def source_files() -> list[Path]:
    """Return the tracked source files of the distributions."""
    command = ["git", "ls-files", "-z", *FOLDERS]
    listing = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    sources = []
    for name in listing.split("\0"):
        path = Path(name)
        is_ours = name.endswith(ENDINGS) and not name.endswith(".min.js")
        if is_ours and "tests" not in path.parts and path.is_file():
            sources.append(path)
    return sources


def docstring_lines(tree: ast.Module) -> set[int]:
    """Return the numbers of the lines that belong to strings that stand alone."""
    numbers: set[int] = set()
    for node in ast.walk(tree):
        if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Constant):
            continue
        if isinstance(node.value.value, str):
            numbers |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return numbers


def code_lines(path: Path, text: str) -> int:
    """Return the number of code lines of a file."""
    comment = "#" if path.suffix == ".py" else "//"
    docstrings = docstring_lines(ast.parse(text)) if path.suffix == ".py" else set()
    total = 0
    for number, line in enumerate(text.splitlines(), 1):
        content = line.strip()
        if content and not content.startswith(comment) and number not in docstrings:
            total += 1
    return total


def main() -> int:
    """Print the sizes; return 1 if a file is over its limit."""
    total = 0
    faults = []
    for path in source_files():
        text = path.read_text(encoding="utf-8")
        total += text.count("\n")
        limit = MAX_CODE_LINES.get(path.suffix)
        if limit is None:
            continue
        lines = code_lines(path, text)
        if lines > limit:
            faults.append(f"{path} has {lines} code lines, the limit is {limit}")
    print(f"{total} lines of source")
    for fault in faults:
        print(fault)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
