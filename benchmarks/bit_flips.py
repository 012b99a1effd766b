"""Single flipped bits anywhere in a dataset: which `stickslip verify` finds, and which reading finds.

python benchmarks/bit_flips.py DATASET [DATASET ...] [--flips 10000] [--seed 0]

DATASET is a directory of any kind, as `stickslip pull` gives it; it is copied. A fifth of the flips are in the files
that vouch for the others (manifest, seal, the group's metadata). The rest are in all files: half of them by size, half
with every file as likely as any other. Each flip is found or silent, twice: for `verify`, and for a user who opens the
dataset and reads the array that the file belongs to. Only `verify` reads the card, the preview, and metadata that the
group's metadata repeat.
"""

import argparse
import shutil
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from stickslip_services.client.verifying import verify
from stickslip_training.data.errors import DatasetError
from stickslip_training.data.reader import DatasetReader

VOUCHING = ("manifest", "zarr.json")


def found_by_reading(root: Path, name: str) -> bool:
    """Tell whether opening the dataset and reading all of one array raises."""
    try:
        with DatasetReader(root) as reader:
            if name in reader.label_names:
                reader.label(name)
            elif name in reader.arrays:
                reader.read(name, reader.slots())
    except DatasetError:
        return True
    return False


def targets(paths: list[Path], root: Path, flips: int, generator: np.random.Generator) -> list[Path]:
    """Choose a file for each flip."""
    names = [path.relative_to(root).as_posix() for path in paths]
    vouching = [path for path, name in zip(paths, names, strict=True) if name.startswith(VOUCHING)]
    sizes = np.array([path.stat().st_size for path in paths])
    rest = flips - flips // 5
    chosen = [vouching[place] for place in generator.integers(len(vouching), size=flips // 5)]
    chosen += [paths[place] for place in generator.choice(len(paths), size=rest // 2, p=sizes / sizes.sum())]
    return chosen + [paths[place] for place in generator.integers(len(paths), size=rest - rest // 2)]


def measure(dataset: Path, flips: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    started = time.process_time()
    with tempfile.TemporaryDirectory(prefix="stickslip-flips-") as scratch:
        root = Path(scratch, "dataset")
        shutil.copytree(dataset, root)
        assert not verify(root)
        paths = sorted(path for path in root.rglob("*") if path.is_file())
        silent: Counter[tuple[str, str]] = Counter()
        count = {"manifest, seal, group": 0, "arrays": 0, "others": 0}
        with DatasetReader(root) as reader:
            arrays = set(reader.arrays)
        for path in targets(paths, root, flips, generator):
            name = path.relative_to(root).as_posix()
            array, inside = name.split("/")[0], "/c/" in name
            group = "manifest, seal, group" if name.startswith(VOUCHING) else "arrays" if inside else "others"
            count[group] += 1
            intact = path.read_bytes()
            bit = int(generator.integers(8 * len(intact)))
            path.write_bytes(intact[: bit // 8] + bytes([intact[bit // 8] ^ 1 << bit % 8]) + intact[bit // 8 + 1 :])
            if not verify(root):
                silent[group, "verify"] += 1
            if not found_by_reading(root, array if array in arrays else ""):
                silent[group, "reading"] += 1
            path.write_bytes(intact)
        assert not verify(root)
    print(f"{dataset.name}: {len(paths)} files, {flips} flips, {time.process_time() - started:.0f} CPU s")
    for group, number in count.items():
        unseen = f"silent in verify {silent[group, 'verify']}, in reading {silent[group, 'reading']}"
        print(f"  {group:24}{number:6} flips; {unseen}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", type=Path, nargs="+")
    parser.add_argument("--flips", type=int, default=10_000, help="in all datasets together")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for dataset in options.datasets:
        measure(dataset, options.flips // len(options.datasets), options.seed)


if __name__ == "__main__":
    main()
