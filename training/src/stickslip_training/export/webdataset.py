"""Tar files for WebDataset: `train-000000.tar` and so on.

A sample is one `SLOT.json` with its labels and a `SLOT.ARRAY.npy` for each other array. Categories are codes, as in the
version; `dataset.json` names them. Infinity and NaN are written as Python's json reads them.
"""

import io
import json
import tarfile
from pathlib import Path

import numpy as np

from stickslip_training.export.content import Content, OnBytes


def write(content: Content, directory: Path, on_bytes: OnBytes) -> None:
    """Write the files into an empty directory."""
    for part in content.parts():
        with tarfile.open(directory / f"{part.split}-{part.number:06d}.tar", "x", format=tarfile.USTAR_FORMAT) as tar:
            labels = {array.name: content.read(array.name, part.slots).tolist() for array in content.labels}
            for place, slot in enumerate(part.slots):
                key = f"{slot:08d}"
                sample = {name: values[place] for name, values in labels.items()}
                _add(tar, f"{key}.json", json.dumps(sample).encode())
                for array in content.others:
                    _add(tar, f"{key}.{array.name}.npy", _npy(content.read(array.name, part.slots[place : place + 1])))
                on_bytes(content.sample_bytes)


def _npy(values: np.ndarray[tuple[int, ...], np.dtype[np.generic]]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values[0], allow_pickle=False)
    return buffer.getvalue()


def _add(tar: tarfile.TarFile, name: str, data: bytes) -> None:
    """Add a file without a time or an owner: the same export has the same bytes."""
    member = tarfile.TarInfo(name)
    member.size = len(data)
    member.mode = 0o644
    tar.addfile(member, io.BytesIO(data))
