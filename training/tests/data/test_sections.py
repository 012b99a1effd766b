"""Datasets whose manifest has sections are read like others, and each section is checked before its
samples are.
"""

import pickle

import numpy as np
import pytest
from stickslip_schemas.base import canonical_json, sha256
from stickslip_schemas.format.manifest import (
    FileEntry,
    ManifestSection,
    section_path,
    section_samples,
)
from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.samples import Samples
from stickslip_training.data.sources import (
    CorruptDataError,
    DatasetError,
    InvalidDatasetError,
    MissingFileError,
    RejectedSampleError,
)


def write_sections(version, **changes):
    """Move what the manifest of a dataset lists of samples into sections.

    `changes` are of the second one.
    """
    manifest = version.manifest
    size = section_samples(manifest.spec)
    labels = {name for name, array in DatasetReader(version.root).arrays.items() if array.is_label}
    shards = [
        file
        for file in manifest.files
        if "/c/" in file.path and file.path.split("/")[0] not in labels
    ]
    (version.root / "manifest").mkdir()
    entries = []
    for number, first in enumerate(range(0, manifest.sample_count, size)):
        within = range(
            first // manifest.spec.samples_per_shard,
            (first + size) // manifest.spec.samples_per_shard,
        )
        section = ManifestSection(
            first=first,
            sample_keys=manifest.sample_keys[first : first + size],
            rejections=tuple(
                item for item in manifest.rejections if first <= item.slot < first + size
            ),
            files=tuple(file for file in shards if int(file.path.split("/")[2]) in within),
        )
        if number == 1:
            section = section.model_copy(update=changes)
        data = canonical_json(section.model_dump(mode="json")).encode()
        (version.root / section_path(number)).write_bytes(data)
        entries.append(FileEntry(path=section_path(number), sha256=sha256(data), size=len(data)))
    version.edit_manifest(
        sections=tuple(entries),
        files=tuple(file for file in manifest.files if file not in shards),
        sample_keys=(),
        rejections=(),
        rejection_counts={"out_of_frame": len(manifest.rejections)},
    )
    return version


@pytest.fixture(autouse=True)
def small_sections(monkeypatch):
    monkeypatch.setattr("stickslip_schemas.format.manifest.SECTION_SAMPLES", 9)


@pytest.fixture
def sectioned(clips, tmp_path):
    """12 clips in shards of 8: two sections, of 8 and 4 samples."""
    return write_sections(clips.copy(tmp_path / "v1"))


def test_it_is_read_like_any_other(clips, sectioned):
    with DatasetReader(clips.root) as whole, DatasetReader(sectioned.root, verify=True) as reader:
        for name in whole.label_names:
            assert np.array_equal(
                reader.label(name), whole.label(name), equal_nan=whole.label(name).dtype.kind == "f"
            )
        for name in ("video", "positions"):
            assert np.array_equal(
                reader.read(name, reader.slots()), whole.read(name, whole.slots())
            )
        assert list(reader.rejections()) == list(whole.rejections())
        listed = {file.path for file in reader.files()}
        assert listed - {file.path for file in whole.files()} == {
            "manifest/0.json",
            "manifest/1.json",
        }
        for rejection in whole.rejections():
            with pytest.raises(RejectedSampleError, match=rejection.message):
                reader.read("video", [rejection.slot])
        again = pickle.loads(pickle.dumps(reader))
        assert np.array_equal(again.read("mu", [0]), whole.read("mu", [0]))
    keys = Samples(sectioned.root, "train")[0]["sample_key"]
    first = int(Samples(clips.root, "train").slots[0])
    assert bytes(keys.tolist()) == bytes.fromhex(clips.manifest.sample_keys[first])


def test_opening_and_filtering_read_no_section(sectioned):
    for number in (0, 1):
        (sectioned.root / section_path(number)).unlink()
    with DatasetReader(sectioned.root) as reader:
        slots = reader.slots("train")
        assert len(np.flatnonzero(reader.label("mu")[slots] > 0.3))
        with pytest.raises(MissingFileError, match=r"manifest/0\.json"):
            reader.read("video", [0])


@pytest.mark.physics
def test_no_flipped_bit_of_a_section_is_silent(sectioned):
    slots = DatasetReader(sectioned.root).slots()
    generator = np.random.default_rng(4)
    silent = []
    for number in (0, 1):
        path = sectioned.root / section_path(number)
        intact = path.read_bytes()
        for bit in generator.choice(8 * len(intact), 200, replace=False).tolist():
            damaged = bytearray(intact)
            damaged[bit // 8] ^= 1 << bit % 8
            path.write_bytes(damaged)
            try:
                with DatasetReader(sectioned.root) as reader:
                    reader.read("mu", slots[slots // 8 == number])
            except DatasetError as error:
                if "manifest/" in str(error):
                    continue
            silent.append((number, bit))
        path.write_bytes(intact)
    assert silent == []


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"first": 7}, CorruptDataError, "must list the samples 8 to 11, and lists 7 to 10"),
        ({"files": ()}, MissingFileError, "is not in the manifest"),
        (
            {"rejections": ()},
            InvalidDatasetError,
            "array valid must be false at the manifest's rejections",
        ),
        ({"sample_keys": tuple(4 * ["0" * 64])}, InvalidDatasetError, r"samples \[8, 10, 11\]"),
    ],
)
def test_a_section_must_fit_the_labels(clips, tmp_path, changes, error, message):
    version = write_sections(clips.copy(tmp_path / "v1"), **changes)
    reader = DatasetReader(version.root)
    reader.read("mu", [0])
    with pytest.raises(error, match=message):
        reader.read("mu", [8])


def test_sections_must_be_all_there(sectioned):
    sectioned.edit_manifest(sections=sectioned.manifest.sections[:1])
    with pytest.raises(InvalidDatasetError, match=r"sections must be 2"):
        DatasetReader(sectioned.root)


def test_a_version_of_an_older_format_is_refused(sectioned):
    sectioned.edit_manifest(format="stickslip-dataset/2")
    with pytest.raises(InvalidDatasetError, match=r"stickslip-dataset/3"):
        DatasetReader(sectioned.root)
