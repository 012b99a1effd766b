"""Make the files of a new test set from its published version.

    python benchmarks/training/freeze_set.py NAME SPEC.json DATASET --about TEXT

Writes NAME.json and NAME.npz into the package `stickslip_training.benchmark`.
"""

import argparse
import json
from pathlib import Path

import stickslip_training.benchmark
from stickslip_training.benchmark.sets import frozen
from stickslip_training.data.reader import DatasetReader


def main() -> None:
    """Write both files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("name")
    parser.add_argument("spec", type=Path)
    parser.add_argument("dataset")
    parser.add_argument("--about", required=True)
    args = parser.parse_args()
    folder = Path(stickslip_training.benchmark.__path__[0]) / "sets"
    with DatasetReader(args.dataset, verify=True) as reader:
        document, seen = frozen(args.name, args.about, json.loads(args.spec.read_text()), reader)
    for suffix, data in ((".json", document), (".npz", seen)):
        (folder / f"{args.name}{suffix}").write_bytes(data)
        print(f"{folder / args.name}{suffix}: {len(data) / 1e3:.1f} kB")


if __name__ == "__main__":
    main()
