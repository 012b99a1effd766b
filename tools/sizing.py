"""Print how much room the data of a coordinator take, for each sample and each 1,000 tasks.

    python tools/sizing.py DATA

It reads a data directory with SQLite and a store in a directory, also while the service runs.
"""

import sqlite3
import sys
from contextlib import closing
from pathlib import Path

MEGABYTE = 1e6


def size_of(directory: Path) -> int:
    """Return the size of the files below a directory [bytes], each hard link once."""
    sizes: dict[int, int] = {}
    for path in directory.rglob("*"):
        if path.is_file():
            status = path.stat()
            sizes[status.st_ino] = status.st_size
    return sum(sizes.values())


def main() -> None:
    """Print a table, in MB."""
    data = Path(sys.argv[1])
    database = data / "coordinator.sqlite3"
    uri = f"file:{database}?mode=ro"
    with closing(sqlite3.connect(uri, uri=True)) as connection:
        (tasks,) = connection.execute("SELECT count(*) FROM tasks").fetchone()
        samples, published = connection.execute(
            "SELECT coalesce(sum(sample_count), 0), coalesce(sum(bytes), 0) FROM dataset_versions"
        ).fetchone()
    if not (tasks and samples):
        sys.exit(f"{data} has no dataset yet")
    used = sum(path.stat().st_size for path in data.glob("coordinator.sqlite3*"))
    store = size_of(data / "store")
    rows = {
        "database": (used, 1000 * used / tasks, "a 1,000 tasks"),
        "datasets": (published, published / samples, "a sample"),
        "whole store": (store, store / samples, "a sample"),
    }
    for name, (total, each, unit) in rows.items():
        print(f"{name:12} {total / MEGABYTE:10.2f} MB, {each / MEGABYTE:.3f} MB {unit}")
    print(f"{samples} samples, {tasks} tasks")


if __name__ == "__main__":
    main()
