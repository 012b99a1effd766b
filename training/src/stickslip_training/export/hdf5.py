"""One HDF5 file: a dataset for each array, with the names, types and values of the version.

The first dimension is the sample, and `slot` says which one. Every chunk has a checksum (fletcher32), which the HDF5
library checks.
"""

import json
from pathlib import Path

import numpy as np
from stickslip_schemas.spec.arrays import ArrayLayout, describe

from stickslip_training.export.content import Content, OnBytes

CHUNK_BYTES = 2**20


def write(content: Content, path: Path, on_bytes: OnBytes) -> None:
    import h5py

    with h5py.File(path, "x") as file:
        for name, value in content.identity().items():
            file.attrs[name] = json.dumps(value) if isinstance(value, dict) else value or ""
        manifest = np.frombuffer(content.manifest(), dtype=np.uint8)
        file.create_dataset("manifest.json", data=manifest, chunks=manifest.shape, compression="gzip", fletcher32=True)
        for array in content.arrays:
            _write_array(file, content, array, on_bytes)


def _write_array(file: object, content: Content, array: ArrayLayout, on_bytes: OnBytes) -> None:
    import h5py

    assert isinstance(file, h5py.Group)
    count = len(content.slots)
    rows = max(1, min(count, CHUNK_BYTES // array.sample_bytes))
    out = file.create_dataset(
        array.name, shape=(count, *array.shape), dtype=array.dtype, chunks=(rows, *array.shape), fletcher32=True
    )
    for dimension, name in zip(out.dims, ("sample", *array.dimensions), strict=True):
        dimension.label = name
    for key, value in describe(array).items():
        out.attrs[key] = json.dumps(value) if isinstance(value, dict) else value
    for first in range(0, count, rows):
        slots = content.slots[first : first + rows]
        out[first : first + len(slots)] = content.read(array.name, slots)
        on_bytes(len(slots) * array.sample_bytes)
