"""Shards for MosaicML Streaming: a directory for each split, with its `index.json`.

Labels of one number are columns of that type, truth values of type uint8. Other arrays are `ndarray` columns of a fixed
type and shape. Categories are codes, as in the version; `dataset.json` names them. Each shard has its SHA-256 in the
index, which `StreamingDataset(validate_hash="sha256")` checks.
"""

from itertools import groupby
from pathlib import Path

from stickslip_schemas.spec.arrays import ArrayLayout

from stickslip_training.export.content import DESCRIPTION, FILE_BYTES, MANIFEST_COPY, Content, OnBytes


def write(content: Content, directory: Path, on_bytes: OnBytes) -> None:
    """Write the directory; a split that has no samples gets none."""
    from streaming import MDSWriter

    directory.mkdir()
    (directory / MANIFEST_COPY).write_bytes(content.manifest())
    (directory / DESCRIPTION).write_bytes(content.description())
    columns = {array.name: _encoding(array) for array in content.arrays}
    for split, parts in groupby(content.parts(), key=lambda part: part.split):
        out = str(directory / split)
        with MDSWriter(out=out, columns=columns, hashes=["sha256"], size_limit=FILE_BYTES) as writer:
            for part in parts:
                labels = {array.name: content.read(array.name, part.slots) for array in content.labels}
                for place in range(len(part.slots)):
                    sample = {name: values[place] for name, values in labels.items()}
                    for array in content.others:
                        sample[array.name] = content.read(array.name, part.slots[place : place + 1])[0]
                    numbers = {
                        name: value.view("uint8") if value.dtype == bool else value for name, value in sample.items()
                    }
                    writer.write(numbers)
                    on_bytes(content.sample_bytes)


def _encoding(array: ArrayLayout) -> str:
    """Return the name that MDS has for a column of such values."""
    dtype = "uint8" if array.dtype == "bool" else array.dtype
    return f"ndarray:{dtype}:{','.join(map(str, array.shape))}" if array.shape else dtype
