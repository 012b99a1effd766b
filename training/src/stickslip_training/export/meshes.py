"""Trajectories of cloth for programs that render or animate: OBJ, one file an instant.

Meshes are in metres, z up, with the flat cloth as texture coordinates from 0 to 1 along its longer side. OBJ is text,
and its numbers, read as 32-bit floats, are those of the dataset, bit by bit.
"""

import json
from pathlib import Path

import numpy as np

from stickslip_training.export.content import Content, OnBytes


def write_obj(content: Content, directory: Path, on_bytes: OnBytes) -> None:
    """Write `SLOT/0000.obj` and so on, one for each instant with all sheets, and `SLOT/labels.json`."""
    names = {array.name for array in content.arrays}
    sheets = [name.removesuffix("positions") for name in sorted(names) if name.split(".")[-1] == "positions"]
    missing = [f"{sheet}{part}" for sheet in sheets or [""] for part in ("positions", "rest", "triangles")]
    if missing := [name for name in missing if name not in names]:
        raise ValueError(f"a mesh needs {', '.join(missing)}, which this part of {content.name} does not have")
    for slot in content.slots:
        alone = np.array([slot])
        folder = directory / f"{slot:08d}"
        folder.mkdir()
        labels = {array.name: content.read(array.name, alone)[0].tolist() for array in content.labels}
        (folder / "labels.json").write_text(json.dumps(labels, indent=2) + "\n")
        written: list[str] = []
        first = 1
        for sheet in sheets:
            positions, rest, triangles = (
                content.read(f"{sheet}{part}", alone)[0] for part in ("positions", "rest", "triangles")
            )
            low = rest.min(axis=0)
            uv = ((rest - low) / (rest.max(axis=0) - low).max()).astype(np.float32)
            fixed = "".join(f"vt {u:.9g} {v:.9g}\n" for u, v in uv.tolist())
            fixed += "".join("f " + " ".join(f"{i}/{i}" for i in face) + "\n" for face in (triangles + first).tolist())
            first += len(rest)
            written = written or [""] * len(positions)
            for instant, vertices in enumerate(positions.tolist()):
                moved = "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices)
                written[instant] += f"o {sheet.removesuffix('.') or 'cloth'}\n{moved}{fixed}"
        for instant, text in enumerate(written):
            (folder / f"{instant:04d}.obj").write_text(text)
        on_bytes(content.sample_bytes)
