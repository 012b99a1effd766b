"""Make the files of a new test set from its published version.

    python benchmarks/training/freeze_set.py NAME SPEC.yaml DATASET --about TEXT [--all]

Writes NAME.json and NAME.npz into the package `stickslip_training.benchmark`.
"""

import argparse
from pathlib import Path

import stickslip_training.benchmark
import yaml
from stickslip_testing.sets import frozen
from stickslip_training.data.reader import DatasetReader, Split


def main() -> None:
    """Write both files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("name")
    parser.add_argument("spec", type=Path)
    parser.add_argument("dataset")
    parser.add_argument("--about", required=True)
    parser.add_argument(
        "--all", action="store_true", help="all samples are to answer, and not the split test"
    )
    args = parser.parse_args()
    split: Split | None = None if args.all else "test"
    folder = Path(stickslip_training.benchmark.__path__[0]) / "sets"
    with DatasetReader(args.dataset) as reader:
        document, control_values = frozen(
            args.name, args.about, yaml.safe_load(args.spec.read_text()), split, reader
        )
    for suffix, data in ((".json", document), (".npz", control_values)):
        (folder / f"{args.name}{suffix}").write_bytes(data)
        print(f"{folder / args.name}{suffix}: {len(data) / 1e3:.1f} kB")


if __name__ == "__main__":
    main()
