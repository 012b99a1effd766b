"""A moving sheet of some samples of a dataset of clips: one label by rows, another by columns.

    .venv/bin/python tools/dataset_sheet.py DATASET OUT.webp --rows material --columns mu [--only
    texture=floral ...]

docs/figures/cloth-friction.webp and cloth-textures.webp are such sheets;
`examples/thesis_cloth_clips.py` makes data. --only takes several values of a label, as in
mu=0.1,0.5.
"""

import argparse
import sys
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from stickslip_schemas.format.pictures import labelled, moving, sheet
from stickslip_schemas.spec.arrays import shown_frames
from stickslip_training.data.reader import DatasetReader
from stickslip_workers.stages.card import text_of


def main() -> None:
    """Write the sheet."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    arguments.add_argument("dataset", type=Path)
    arguments.add_argument("out", type=Path)
    arguments.add_argument("--rows", required=True)
    arguments.add_argument("--columns", required=True)
    arguments.add_argument(
        "--only", nargs="*", default=[], metavar="LABEL=VALUE,...", help="which samples"
    )
    arguments.add_argument("--frames", type=int, default=15)
    arguments.add_argument("--side", type=int, default=112, help="of a picture [px]")
    arguments.add_argument("--quality", type=int, default=45, help="of the WebP, 1 to 100")
    options = arguments.parse_args()
    with DatasetReader(options.dataset) as reader:
        chosen = reader.valid.copy()
        for name, _, value in (condition.partition("=") for condition in options.only):
            chosen &= np.isin(_named(reader, name), value.split(","))
        rows, columns = _named(reader, options.rows), _named(reader, options.columns)
        across = list(dict.fromkeys(columns[chosen].tolist()))
        tiles = []
        for row, column in product(dict.fromkeys(rows[chosen].tolist()), across):
            slot = int(np.flatnonzero(chosen & (rows == row) & (columns == column))[0])
            (clip,) = reader.read("video", [slot])
            clip = clip[list(shown_frames(min(options.frames, len(clip)), len(clip)))]
            tiles.append(labelled(clip, text_of({"row": row, "column": column}), options.side))
    data = moving(sheet(tiles, len(across)), quality=options.quality)
    options.out.write_bytes(data)
    sys.stdout.write(f"{options.out}: {len(tiles)} clips, {len(data) / 1e3:.0f} kB\n")


def _named(reader: DatasetReader, name: str) -> Any:
    """Return a label of all slots as texts."""
    values, categories = reader.label(name), reader.categories(name)
    return np.array(
        [categories[value] if categories else f"{value:.3g}" for value in values.tolist()]
    )


if __name__ == "__main__":
    main()
