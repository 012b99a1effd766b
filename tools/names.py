"""Refuse names that are not the field's: part of `make check`.

    python tools/names.py            fail if a file uses a private word that it did not use before
    python tools/names.py --record   record the words that files use now

A word of PRIVATE misleads a reader of the field; the right term stands beside it. A word of
PRONOUNS stands for a thing that has a name. tools/names_in_use.json lists the files that still use
one: a rewritten file leaves the list, and no file joins it.
"""

import argparse
import ast
import json
import re
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
IN_USE = Path(__file__).with_name("names_in_use.json")
FOLDERS = (
    "schemas",
    "services",
    "sim_core/python",
    "sim_core/src",
    "sim_core/tests",
    "training",
    "measure",
    "workers",
    "testing",
    "tests",
    "tools",
    "benchmarks",
    "examples",
)
SUFFIXES = (".py", ".cpp", ".hpp")
GENERATED = {"build", "node_modules", ".venv", ".venv-blender"}
"""Folders that hold no source of this project."""

PRIVATE = {
    "asker": "principal",
    "bearing": "BodyContact",
    "book": "tx, for a QueueTransaction",
    "charge": "leased_for, a fact that the lease sets",
    "ease": "coarsen_if_cheap",
    "fate": "initial_state",
    "give_back": "requeue, release",
    "give_up": "release_tasks",
    "given_up": "released",
    "holds_alone": "has_exclusive_lease",
    "ledger": "transaction",
    "lose": "requeue_lost",
    "mend": "recompute",
    "mine": "the noun",
    "note_heard": "touch_workers",
    "note_seen": "record_condition",
    "note_stranded": "update_unschedulable_jobs",
    "sort_out": "reconcile_leases",
    "strained": "stalled",
    "take_back": "expire_leases",
    "tame": "is_exact",
    "trio": "measured_group",
    "workshop": "RenderContext",
}
"""Words that mislead a reader of the field, and the terms to use."""

PRONOUNS = ("mine", "one", "others", "ours", "own", "some", "what", "which", "who", "whom")
PARTICIPLES = ("found", "given", "kept", "made", "ran", "said", "seen", "shown", "taken", "told")
"""Pronouns and participles: a variable is named after the thing that it holds.

A participle that the field uses as a noun or as an adjective stays: `held` vertices, a `known`
curvature, the `expected` value.
"""


def python_names(text: str) -> set[str]:
    """Return the identifiers of a Python file."""
    names = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Name):
            names.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.attr)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            names.add(node.name)
    return names


def cpp_names(text: str) -> set[str]:
    """Return the identifiers of a C++ file, without comments and strings."""
    code = re.sub(r"//.*|\"(?:\\.|[^\"\\])*\"", "", text)
    return set(re.findall(r"[A-Za-z_]\w*", code))


def refused_words(path: Path) -> set[str]:
    """Return the refused words that a file uses as names."""
    text = path.read_text(encoding="utf-8")
    names = python_names(text) if path.suffix == ".py" else cpp_names(text)
    # A private name begins with an underscore, and a name that a keyword takes ends with one.
    words = {name.strip("_").lower() for name in names}
    return words & {*PRIVATE, *PRONOUNS, *PARTICIPLES}


def words_in_use() -> dict[str, list[str]]:
    """Return the refused words of every source file that has some, by the path of the file."""
    words: dict[str, list[str]] = {}
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*")):
            parts = path.relative_to(ROOT).parts
            if path.suffix in SUFFIXES and not GENERATED & set(parts):
                refused = refused_words(path)
                if refused:
                    words[path.relative_to(ROOT).as_posix()] = sorted(refused)
    return words


def main() -> int:
    """Compare the words in use with the record, or write it."""
    parser = argparse.ArgumentParser(description="Refuse names that are not the field's.")
    parser.add_argument("--record", action="store_true", help="write the words in use now")
    options = parser.parse_args()
    words = words_in_use()
    if options.record:
        IN_USE.write_text(json.dumps(words, indent=1) + "\n", encoding="utf-8")
        return 0
    known = defaultdict(list, json.loads(IN_USE.read_text(encoding="utf-8")))
    faults = []
    for path, refused in words.items():
        for word in refused:
            if word not in known[path]:
                term = PRIVATE.get(word, "the noun of the thing that it holds")
                faults.append(f"{path}: the name {word!r} is refused; use {term}")
    for fault in faults:
        print(fault)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
