"""Refuse circles of rooms among the includes of the C++ core.

A room is a folder of `sim_core/src`. Rooms include each other one way only: then a reader can learn
them one after another, from the bottom up.
"""

import re
import sys
from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "sim_core" / "src"

INCLUDE = re.compile(r'^#include "([^"/]+)/[^"]+"', re.MULTILINE)
"""Includes of a header in another folder, or in the file's own."""


def includes(source: Path) -> dict[str, set[str]]:
    """Return the rooms that each room includes, without itself."""
    graph: dict[str, set[str]] = {}
    for path in sorted(source.glob("*/**/*")):
        if path.suffix not in {".cpp", ".hpp"}:
            continue
        room = path.relative_to(source).parts[0]
        included = set(INCLUDE.findall(path.read_text(encoding="utf-8")))
        graph.setdefault(room, set()).update(included - {room})
    return graph


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    """Return the rooms of a circle, each of which is included by the next, or none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        rooms: list[str] = error.args[1]
        return rooms
    return []


def main() -> int:
    """Print a circle, if there is one, and return the exit status."""
    rooms = circle(includes(SOURCE))
    if rooms:
        print(
            f"sim_core/src: rooms include each other in a circle: {' <- '.join(rooms)}. Move what "
            "both need to the lower room."
        )
    return 1 if rooms else 0


if __name__ == "__main__":
    sys.exit(main())
