"""A part of a version in a directory: its samples are read, and no others."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stickslip_schemas.base import sha256
from stickslip_schemas.format.manifest import Contents
from stickslip_schemas.format.selection import SELECTION_NAME, PartDocument, Selection, part_files
from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.sources import (
    CorruptDataError,
    InvalidDatasetError,
    MissingFileError,
    RejectedSampleError,
)
from stickslip_training.export.formats import Content

SELECTION = Selection(arrays=("video",), where=("material==gray-interlock",))


@pytest.fixture
def part(clips: Any, tmp_path: Path) -> Any:
    """The clips of one fabric, without meshes."""
    copy = clips.copy(tmp_path / "part")
    with DatasetReader(copy.root) as whole:
        contents = Contents(copy.manifest, whole.source.read)
        paths = {file.path for file in part_files(contents, SELECTION, whole.label)}
    for file in copy.manifest.files:
        if file.path not in paths:
            (copy.root / file.path).unlink()
    assert len(paths) < len(copy.manifest.files)
    write_selection(copy.root, SELECTION)
    return copy


def write_selection(root: Path, selection: Selection) -> None:
    manifest = sha256((root / "manifest.json").read_bytes())
    (root / SELECTION_NAME).write_text(
        PartDocument(manifest=manifest, selection=selection).model_dump_json()
    )


def test_the_samples_of_a_part_are_read(part: Any) -> None:
    code = DatasetReader(part.root).categories("material").index("gray-interlock")
    chosen = np.flatnonzero((part.arrays["material"] == code) & part.arrays["valid"])
    with DatasetReader(part.root, verify=True) as reader:
        assert reader.slots().tolist() == chosen.tolist()
        assert len(chosen) > 0
        assert np.array_equal(reader.read("video", chosen), part.arrays["video"][chosen])
        assert np.array_equal(pickle.loads(pickle.dumps(reader)).slots(), chosen)
        assert len(reader) == len(part.arrays["valid"])
        content = Content(reader, Selection())
        assert content.slots.tolist() == chosen.tolist()


def test_what_is_not_in_a_part_is_an_error(part: Any) -> None:
    with DatasetReader(part.root) as reader:
        other = np.flatnonzero(part.arrays["valid"] & ~reader.chosen)
        with pytest.raises(MissingFileError, match="is not in the part of the dataset"):
            reader.read("video", other[:1])
        with pytest.raises(RejectedSampleError):
            reader.read("video", [3])
        with pytest.raises(ValueError, match="array must be one of video"):
            reader.read("positions", reader.slots()[:1])


def test_a_part_of_which_a_file_is_missing_or_damaged_is_an_error(part: Any) -> None:
    path = next(path for path in sorted(part.root.glob("video/c/*/*/*/*/*")))
    data = path.read_bytes()
    path.unlink()
    with pytest.raises(MissingFileError):
        DatasetReader(part.root, verify=True)
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(CorruptDataError):
        DatasetReader(part.root, verify=True)


def test_a_selection_of_something_else_is_an_error(part: Any) -> None:
    path = part.root / SELECTION_NAME
    path.write_text(PartDocument(manifest="0" * 64, selection=SELECTION).model_dump_json())
    with pytest.raises(InvalidDatasetError, match="is of another version"):
        DatasetReader(part.root)
    path.write_text("{")
    with pytest.raises(InvalidDatasetError, match="is damaged"):
        DatasetReader(part.root)
