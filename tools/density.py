"""Measure how dense the code is, beside codebases that the field reads with ease: `make density`.

    python tools/density.py [NAME=FOLDER[,FOLDER ...] ...]

Per 1,000 code lines of Python (no blank line, comment or docstring): packed assignments
(`a, b = x, y` of values that are not swapped), comprehensions inside comprehensions, and comment
lines; beside them the mean characters of a code line. It warns and never fails: a limit on a number
makes people write for the number.
"""

import ast
import sys
from dataclasses import dataclass
from pathlib import Path

from size import docstring_lines

ROOT = Path(__file__).parents[1]
DISTRIBUTIONS: dict[str, tuple[str, ...]] = {
    "schemas": ("schemas/src",),
    "services": ("services/src",),
    "sim_core": ("sim_core/python",),
    "training": ("training/src",),
    "measure": ("measure/src",),
    "workers": ("workers/src",),
    "blender": ("workers/blender/src",),
}
CPP = {"sim_core, C++": "sim_core/src", "raster, C++": "workers/blender/raster"}
MODELS = (
    ("httpx, zarr, prefect server,", "", "", "", ""),
    ("torchtitan, newton (2026)", "0.3-1.0", "0.1-0.9", "28-33", "46-102"),
    ("ipc-toolkit, C++ (2026)", "", "", "32", "192"),
)
"""The same numbers of the models: packed, nested, characters a line, comment lines."""

MAX_PACKED = 5.0
MAX_NESTED = 2.0
MAX_CHARACTERS = 40.0
MIN_COMMENTS = 25.0
"""From here on a distribution is marked: it reads worse than each of the models."""

COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


@dataclass
class Density:
    """Counts over the files of a distribution."""

    code_lines: int = 0
    characters: int = 0
    comment_lines: int = 0
    packed: int = 0
    nested: int = 0

    def per_thousand(self, count: int) -> float:
        """Return a count per 1,000 code lines."""
        return 1000 * count / max(self.code_lines, 1)

    @property
    def mean_characters(self) -> float:
        """The mean characters of a code line, without its indentation."""
        return self.characters / max(self.code_lines, 1)


def is_packed(node: ast.AST) -> bool:
    """Return whether a node assigns several values to several names, and does not swap them."""
    if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Tuple):
        return False
    if not isinstance(node.targets[0], ast.Tuple):
        return False
    targets = {ast.unparse(element) for element in node.targets[0].elts}
    values = {ast.unparse(element) for element in node.value.elts}
    return targets != values


def is_nested(node: ast.AST) -> bool:
    """Return whether a node is a comprehension with another one, or with two loops."""
    if not isinstance(node, COMPREHENSIONS):
        return False
    if len(node.generators) > 1:
        return True
    return any(isinstance(child, COMPREHENSIONS) for child in ast.walk(node) if child is not node)


def add_python(density: Density, text: str) -> None:
    """Count a file of Python."""
    tree = ast.parse(text)
    docstrings = docstring_lines(tree)
    for number, line in enumerate(text.splitlines(), 1):
        content = line.strip()
        if content.startswith("#"):
            density.comment_lines += 1
        elif content and number not in docstrings:
            density.code_lines += 1
            density.characters += len(content)
    for node in ast.walk(tree):
        density.packed += is_packed(node)
        density.nested += is_nested(node)


def add_cpp(density: Density, text: str) -> None:
    """Count a file of C++."""
    for line in text.splitlines():
        content = line.strip()
        if content.startswith("//"):
            density.comment_lines += 1
        elif content:
            density.code_lines += 1
            density.characters += len(content)


def measure(folders: tuple[str, ...], suffixes: tuple[str, ...]) -> Density:
    """Return the density of the files in some folders, without tests and migrations."""
    density = Density()
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*")):
            parts = path.relative_to(ROOT / folder).parts
            if path.suffix not in suffixes or {"tests", "migrations"} & set(parts):
                continue
            text = path.read_text(encoding="utf-8")
            if path.suffix == ".py":
                add_python(density, text)
            else:
                add_cpp(density, text)
    return density


def row(name: str, density: Density, *, is_python: bool) -> tuple[str, str, str, str, str]:
    """Return a row of the table; a number beyond a threshold has a star."""

    def mark(value: float, is_beyond: bool) -> str:
        return f"{value:.1f}{'*' if is_beyond else ''}"

    packed = density.per_thousand(density.packed)
    nested = density.per_thousand(density.nested)
    comments = density.per_thousand(density.comment_lines)
    characters = density.mean_characters
    return (
        name,
        mark(packed, packed > MAX_PACKED) if is_python else "",
        mark(nested, nested > MAX_NESTED) if is_python else "",
        mark(characters, characters > MAX_CHARACTERS),
        mark(comments, comments < MIN_COMMENTS),
    )


def main(arguments: list[str]) -> int:
    """Print the table of our distributions, or of the given folders, above that of the models."""
    folders = dict(DISTRIBUTIONS)
    if arguments:
        folders = {}
        for argument in arguments:
            name, _, names = argument.partition("=")
            folders[name] = tuple(names.split(","))
    rows = [("per 1,000 code lines", "packed", "nested", "chars a line", "comment lines")]
    for name, places in folders.items():
        rows.append(row(name, measure(places, (".py",)), is_python=True))
    if not arguments:
        for name, folder in CPP.items():
            rows.append(row(name, measure((folder,), (".cpp", ".hpp")), is_python=False))
    rows += MODELS
    for name, packed, nested, characters, comments in rows:
        print(f"{name:30} {packed:>8} {nested:>8} {characters:>13} {comments:>14}")
    print(
        f"* over {MAX_PACKED:g} packed, {MAX_NESTED:g} nested or {MAX_CHARACTERS:g} characters,"
        f" or fewer than {MIN_COMMENTS:g} comment lines"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
