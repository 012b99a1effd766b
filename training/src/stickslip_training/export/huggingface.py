"""Parquet files for Hugging Face `datasets`: `data/train-00000-of-00002.parquet` and so on, and a card.

Each file carries the features, so `datasets.load_dataset(DIR)` gives every array with its shape and type, and every
categorical label with its names.
"""

from pathlib import Path
from typing import Any

from stickslip_schemas.spec.arrays import ArrayLayout

from stickslip_training.arrays import Array
from stickslip_training.export.content import DESCRIPTION, MANIFEST_COPY, Content, OnBytes

GROUP_BYTES = 32 * 2**20
"""Decoded samples that are written and read together [bytes]."""


def write(content: Content, directory: Path, on_bytes: OnBytes) -> None:
    """Write the files into an empty directory."""
    import datasets
    import pyarrow
    from pyarrow import parquet

    (directory / "data").mkdir()
    schema = datasets.Features({array.name: _feature(array) for array in content.arrays}).arrow_schema
    rows = max(1, GROUP_BYTES // content.sample_bytes)
    splits = []
    for part in content.parts():
        splits += [part.split] if part.number == 0 else []
        path = directory / "data" / f"{part.split}-{part.number:05d}-of-{part.count:05d}.parquet"
        with parquet.ParquetWriter(path, schema, compression="zstd", write_page_checksum=True) as writer:
            for first in range(0, len(part.slots), rows):
                slots = part.slots[first : first + rows]
                columns = [
                    _column(content.read(array.name, slots), schema.field(array.name).type) for array in content.arrays
                ]
                writer.write_table(pyarrow.Table.from_arrays(columns, schema=schema))
                on_bytes(len(slots) * content.sample_bytes)
    (directory / "README.md").write_text(_card(content, splits), encoding="utf-8")


def _feature(array: ArrayLayout) -> Any:
    import datasets

    if array.categories:
        return datasets.ClassLabel(names=list(map(str, array.categories)))
    if not array.shape:
        return datasets.Value(array.dtype)
    if len(array.shape) == 1:
        return datasets.Sequence(datasets.Value(array.dtype), length=array.shape[0])
    of_rank = {2: datasets.Array2D, 3: datasets.Array3D, 4: datasets.Array4D, 5: datasets.Array5D}
    return of_rank[len(array.shape)](array.shape, array.dtype)


def _column(values: Array, kind: Any) -> Any:
    """Return values as an Arrow array of the type `kind`: plain numbers, or lists in lists for the further axes."""
    import pyarrow

    column = pyarrow.array(values.reshape(-1))
    for size in values.shape[:0:-1]:
        column = pyarrow.FixedSizeListArray.from_arrays(column, size)
    if not isinstance(kind, pyarrow.ExtensionType):
        return column.cast(kind)
    return pyarrow.ExtensionArray.from_storage(kind, column.cast(kind.storage_type))


def _card(content: Content, splits: list[str]) -> str:
    files = "".join(f"  - split: {split}\n    path: data/{split}-*.parquet\n" for split in splits)
    arrays = "\n".join(
        f"| `{array.name}` | {' x '.join(map(str, array.shape)) or 'one value'} | {array.dtype} | {array.description} |"
        for array in content.arrays
    )
    return f"""---
configs:
- config_name: default
  data_files:
{files}---

# {content.title}

This is an export of the dataset `{content.name}`, which stickslip made: {len(content.slots)} samples. The manifest of
that version is `{MANIFEST_COPY}` here; its SHA-256 is `{content.reader.manifest_digest}`.
`{DESCRIPTION}` describes the arrays for programs.

```python
from datasets import load_dataset

dataset = load_dataset("PATH OF THIS DIRECTORY").with_format("numpy")
```

The format "numpy" of `datasets` rounds float64 to float32, unless you give it a `dtype`.

| column | shape | type | meaning |
|---|---|---|---|
{arrays}
"""
