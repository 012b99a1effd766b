import json
import os
import pickle
import re
import shutil
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
import zarr
from stickslip_schemas.base import sha256
from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.sources import (
    CorruptDataError,
    DatasetError,
    InvalidDatasetError,
    MissingFileError,
    RejectedSampleError,
)


@pytest.mark.parametrize("name", ["clips", "rods", "seen_rods"])
def test_reads_bit_for_bit_what_zarr_python_wrote_and_reads(name, request):
    version = request.getfixturevalue(name)
    reader = DatasetReader(version.root, verify=True)
    group = zarr.open_group(str(version.root), mode="r")
    assert set(group.array_keys()) == set(reader.arrays)
    slots = reader.slots()
    shuffled = np.random.default_rng(0).permutation(slots)
    for array in reader.arrays:
        values = reader.read(array, shuffled)
        assert values.dtype == version.arrays[array].dtype
        assert values.tobytes() == version.arrays[array][shuffled].tobytes()
        assert values.tobytes() == group[array][:][shuffled].tobytes()


def test_rejected_samples_are_skipped_and_cannot_be_read(clips):
    reader = DatasetReader(clips.root)
    assert len(reader) == 12
    assert reader.slots().tolist() == [slot for slot in range(12) if slot not in (3, 9)]
    with pytest.raises(
        RejectedSampleError, match="sample 9 was rejected: out_of_frame, leaves view 2"
    ):
        reader.read("video", [9])
    with pytest.raises(RejectedSampleError):
        reader.read("mu", [3])


def test_splits_part_the_valid_samples(rods):
    reader = DatasetReader(rods.root)
    parts = [reader.slots(split) for split in ("train", "validation", "test")]
    assert sorted(np.concatenate(parts).tolist()) == reader.slots().tolist()
    assert [len(part) for part in parts] == list(rods.manifest.split_counts.values())
    assert all(len(part) for part in parts)
    with pytest.raises(
        ValueError, match="split must be one of train, validation, test, and is all"
    ):
        reader.slots("all")


def test_reads_into_the_given_buffer_and_no_other(clips):
    reader = DatasetReader(clips.root)
    buffer = np.zeros((4, *clips.arrays["video"].shape[1:]), dtype=np.uint8)
    reader.read_into("video", [7, 0], buffer[1:3])
    assert np.array_equal(buffer[1:3], clips.arrays["video"][[7, 0]])
    assert not buffer[[0, 3]].any()
    for bad in (buffer[:3], buffer[:2].astype(np.int8), buffer[::2]):
        with pytest.raises(ValueError, match="out must be C-ordered uint8 of shape"):
            reader.read_into("video", [7, 0], bad)


def test_names_and_slots_are_checked(clips):
    reader = DatasetReader(clips.root)
    with pytest.raises(ValueError, match="array must be one of video, texture"):
        reader.read("vdieo", [0])
    with pytest.raises(IndexError, match="slot must be from 0 to 11, and is 12"):
        reader.read("video", [12])
    with pytest.raises(IndexError):
        reader.read("video", [-1])
    with pytest.raises(ValueError, match="video is no label; the labels are texture"):
        reader.label("video")


def test_curves_are_the_same_with_the_smallest_cache(rods):
    reader = DatasetReader(rods.root, cache_bytes=0)
    slots = np.random.default_rng(0).permutation(reader.slots())
    assert np.array_equal(reader.read("centerline", slots), rods.arrays["centerline"][slots])
    assert len(reader.index._chunks) == 1


def test_pickles(clips):
    reader = DatasetReader(clips.root)
    reader.read("video", [0])
    again = pickle.loads(pickle.dumps(reader))
    assert np.array_equal(again.read("video", [8]), clips.arrays["video"][[8]])


def test_works_in_a_forked_child_after_use_in_the_parent(clips):
    reader = DatasetReader(clips.root)
    reader.read("video", [0])
    child = os.fork()
    if child == 0:
        same = np.array_equal(reader.read("video", [8]), clips.arrays["video"][[8]])
        os._exit(0 if same else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert np.array_equal(reader.read("video", [7]), clips.arrays["video"][[7]])


# --- damage
# --------------------------------------------------------------------------------------------------


def is_told(root, shard):
    """Return whether reading the array of a damaged shard, whole, raises."""
    name = shard.relative_to(root).parts[0]
    try:
        reader = DatasetReader(root)
        reader.read(name, reader.slots())
        if name in reader.label_names:
            reader.label(name)
    except CorruptDataError:
        return True
    return False


@pytest.mark.physics
def test_no_flipped_bit_is_silent(clips, tmp_path):
    """Single flips anywhere in the files of shards and labels: 6 in each file, and 100 more."""
    version = clips.copy(tmp_path / "v1")
    shards = [version.root / file.path for file in version.manifest.files if "/c/" in file.path]
    sizes = np.array([path.stat().st_size for path in shards])
    generator = np.random.default_rng(3)
    targets = np.concatenate(
        [np.repeat(np.arange(len(shards)), 6), generator.choice(len(shards), 100)]
    )
    silent = []
    for target in targets:
        path = shards[target]
        intact = path.read_bytes()
        bit = int(generator.integers(8 * sizes[target]))
        damaged = bytearray(intact)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        if not is_told(version.root, path):
            silent.append((path.name, bit))
        path.write_bytes(intact)
    assert silent == []


def test_the_message_about_a_corrupt_chunk_names_array_sample_and_file(clips, tmp_path):
    version = clips.copy(tmp_path / "v1")
    path = version.root / "video/c/0/0/0/0/0"
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    reader = DatasetReader(version.root, check_shards=False)
    with pytest.raises(
        CorruptDataError,
        match=r"array video, sample 0, .*video/c/0/0/0/0/0: the crc32c of the chunk",
    ):
        reader.read("video", [0])
    assert np.array_equal(reader.read("video", [1]), version.arrays["video"][[1]])
    with pytest.raises(
        CorruptDataError, match=r"video/c/0/0/0/0/0 has SHA-256 .*, and the manifest says"
    ):
        DatasetReader(version.root).read("video", [1])
    with pytest.raises(
        CorruptDataError, match=r"video/c/0/0/0/0/0 has SHA-256 .*, and the manifest says"
    ):
        DatasetReader(version.root, verify=True)


@pytest.mark.parametrize("remaining", [0, 3, 1000, -1])
def test_a_truncated_shard_raises(clips, tmp_path, remaining):
    version = clips.copy(tmp_path / "v1")
    path = version.root / "video/c/1/0/0/0/0"
    path.write_bytes(path.read_bytes()[:remaining])
    reader = DatasetReader(version.root, check_shards=False)
    with pytest.raises(CorruptDataError, match=r"has \d+ bytes, and the manifest says"):
        reader.read("video", [8])


@pytest.mark.parametrize("remaining", [0, 3, 1000, -1])
def test_a_truncated_shard_raises_where_the_manifest_agrees_with_it(clips, tmp_path, remaining):
    version = clips.copy(tmp_path / "v1")
    path = "video/c/1/0/0/0/0"
    version.rewrite(path, (version.root / path).read_bytes()[:remaining])
    reader = DatasetReader(version.root)
    with pytest.raises(
        CorruptDataError,
        match=r"array video.*(too short for a shard index|crc32c of the shard index)",
    ):
        reader.read("video", [8])


def test_a_missing_shard_raises(clips, tmp_path):
    version = clips.copy(tmp_path / "v1")
    (version.root / "video/c/1/0/0/0/0").unlink()
    reader = DatasetReader(version.root)
    reader.read("video", [0])
    with pytest.raises(
        MissingFileError, match=r"video/c/1/0/0/0/0 is not there, and the manifest says it is"
    ):
        reader.read("video", [8])
    (version.root / "valid/c/0").unlink()
    with pytest.raises(MissingFileError):
        DatasetReader(version.root)


def test_a_shard_that_is_not_in_the_manifest_raises_although_it_is_there(clips, tmp_path):
    version = clips.copy(tmp_path / "v1")
    files = version.manifest.files
    version.edit_manifest(files=tuple(file for file in files if file.path != "video/c/1/0/0/0/0"))
    with pytest.raises(
        MissingFileError, match=r"array video, shard 1: video/c/1/0/0/0/0 is not in the manifest"
    ):
        DatasetReader(version.root)


def test_a_valid_sample_without_a_chunk_raises(clips, tmp_path):
    """Another writer left a chunk out as if it were all fill value: zarr-python reads zeros."""
    version = clips.copy(tmp_path / "v1")
    group = zarr.open_group(str(version.root), mode="r+")
    group["video"][8] = 0
    version.rewrite("video/c/1/0/0/0/0", (version.root / "video/c/1/0/0/0/0").read_bytes())
    with pytest.raises(CorruptDataError, match="array video, sample 8: its chunk is missing in"):
        DatasetReader(version.root).read("video", [8])


def test_a_chunk_of_another_size_raises(clips, tmp_path):
    """A smaller chunk with a good checksum would leave a part of the buffer as it was."""
    from stickslip_schemas.format.codecs import encode_clip, encode_shard

    version = clips.copy(tmp_path / "v1")
    shape = version.arrays["video"].shape[1:]
    chunks = [encode_clip(np.ones(shape, np.uint8)[: 1 + (slot == 4)]) for slot in range(8)]
    version.rewrite("video/c/0/0/0/0/0", encode_shard(chunks))
    reader = DatasetReader(version.root)
    assert reader.read("video", [4]).all()
    with pytest.raises(
        CorruptDataError, match=r"sample 2, .*the chunk decodes to 150528 bytes, and 301056"
    ):
        reader.read("video", [2])


def test_an_uncommitted_directory_is_no_dataset(tmp_path):
    with pytest.raises(MissingFileError, match="this is no committed dataset version"):
        DatasetReader(tmp_path)
    with pytest.raises(MissingFileError):
        DatasetReader(tmp_path / "nothing")


NAMED = re.compile(r"manifest\.json|zarr\.json|manifest\.sha256")


def test_no_flipped_bit_in_the_files_that_vouch_for_the_others_is_silent(rods, tmp_path):
    """2,000 single flips, in each file as many as its share of the bytes, and 100 at least."""
    version = rods.copy(tmp_path / "v1")
    paths = [version.root / name for name in ("manifest.json", "zarr.json", "manifest.sha256")]
    sizes = np.array([path.stat().st_size for path in paths])
    generator = np.random.default_rng(4)
    counts = 100 + generator.multinomial(1700, sizes / sizes.sum())
    silent = []
    for path, count in zip(paths, counts, strict=True):
        intact = path.read_bytes()
        for bit in generator.integers(8 * len(intact), size=count).tolist():
            damaged = bytearray(intact)
            damaged[bit // 8] ^= 1 << bit % 8
            path.write_bytes(damaged)
            try:
                DatasetReader(version.root)
            except DatasetError as error:
                if NAMED.search(str(error)):
                    continue
            silent.append((path.name, bit))
        path.write_bytes(intact)
    assert silent == []
    DatasetReader(version.root)


@pytest.mark.physics
def test_no_swap_of_shards_of_one_size_is_silent(clips, tmp_path):
    """200 swaps: those that chance makes equal in size, and a sample's chunk that is put where
    another's was.
    """
    version = clips.copy(tmp_path / "v1")
    shards = [version.root / file.path for file in version.manifest.files if "/c/" in file.path]
    content = {path: path.read_bytes() for path in shards}
    pairs = [(a, b) for a in shards for b in shards if a < b and content[a] != content[b]]
    pairs = [(a, b) for a, b in pairs if len(content[a]) == len(content[b])]
    generator = np.random.default_rng(5)
    silent = 0
    for place in generator.integers(len(pairs), size=200):
        a, b = pairs[place]
        a.write_bytes(content[b])
        b.write_bytes(content[a])
        silent += not (is_told(version.root, a) and is_told(version.root, b))
        a.write_bytes(content[a])
        b.write_bytes(content[b])
    assert len({path for pair in pairs for path in pair}) > 10
    assert silent == 0


def test_a_sample_that_changed_its_place_in_a_shard_raises(clips, tmp_path):
    """Every chunk has its checksum, and the file its size: only the manifest knows whose chunk it
    was.
    """
    version = clips.copy(tmp_path / "v1")
    path = version.root / "video/c/0/0/0/0/0"
    data, index = path.read_bytes(), -(16 * 8 + 4)
    places = np.frombuffer(data[index:-4], dtype="<u8").reshape(8, 2).copy()
    places[[0, 1]] = places[[1, 0]]
    body = data[:index] + places.tobytes()
    path.write_bytes(body + google_crc32c.value(places.tobytes()).to_bytes(4, "little"))
    swapped = DatasetReader(version.root, check_shards=False)
    assert np.array_equal(swapped.read("video", [0]), version.arrays["video"][[1]])
    with pytest.raises(CorruptDataError, match=r"video/c/0/0/0/0/0 has SHA-256"):
        DatasetReader(version.root).read("video", [0])


def test_a_version_without_its_seal_is_refused(clips, tmp_path):
    version = clips.copy(tmp_path / "v1")
    (version.root / "manifest.sha256").unlink()
    with pytest.raises(MissingFileError, match=r"manifest.sha256 is not there"):
        DatasetReader(version.root)


def test_each_of_the_three_is_checked(clips, tmp_path):
    version = clips.copy(tmp_path / "v1")
    group, seal_of = version.root / "zarr.json", version.root / "manifest.sha256"
    other = sha256(b"other")
    group.write_text(
        group.read_text().replace(sha256((version.root / "manifest.json").read_bytes()), other)
    )
    with pytest.raises(CorruptDataError, match=r"zarr.json has SHA-256"):
        DatasetReader(version.root)
    lines = [
        f"{sha256((version.root / name).read_bytes())}  {name}\n"
        for name in ("manifest.json", "zarr.json")
    ]
    seal_of.write_text("".join(lines))
    with pytest.raises(
        CorruptDataError, match=f"manifest_sha256 must be that of manifest.json, .*, and is {other}"
    ):
        DatasetReader(version.root)
    version.seal()
    seal_of.write_text("".join(lines) + "\n")
    with pytest.raises(CorruptDataError, match=r"manifest.sha256"):
        DatasetReader(version.root)


# --- contradictions
# -------------------------------------------------------------------------------------------


def test_the_manifest_must_be_one(clips, tmp_path):
    version = clips.copy(tmp_path / "v1")
    (version.root / "manifest.json").write_text("{}")
    version.seal()
    with pytest.raises(InvalidDatasetError, match="the manifest does not hold to the contract"):
        DatasetReader(version.root)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sample_count": 13}, "sample_count of the manifest is 13, its spec asks for 12"),
        ({"valid_count": 11}, "valid_count of the manifest is 11"),
        (
            {"rejections": (), "valid_count": 12},
            "array valid must be false at the manifest's rejections",
        ),
        ({"split_counts": {"train": 1}}, "split_counts of the manifest"),
    ],
)
def test_the_manifest_must_not_contradict_itself_or_the_arrays(clips, tmp_path, changes, message):
    version = clips.copy(tmp_path / "v1")
    version.edit_manifest(**changes)
    with pytest.raises(InvalidDatasetError, match=message):
        DatasetReader(version.root)


def test_the_manifest_of_another_dataset_is_refused(clips, rods, tmp_path):
    version = clips.copy(tmp_path / "v1")
    (version.root / "manifest.json").write_text(rods.manifest.model_dump_json())
    with pytest.raises(
        CorruptDataError, match=r"manifest.json has SHA-256 .*, and manifest.sha256 says"
    ):
        DatasetReader(version.root)
    shutil.copy(rods.root / "manifest.sha256", version.root)
    with pytest.raises(
        CorruptDataError, match=r"zarr.json has SHA-256 .*, and manifest.sha256 says"
    ):
        DatasetReader(version.root)


def test_sample_keys_must_be_those_of_the_manifest(clips, tmp_path):
    version = clips.copy(tmp_path / "v1")
    keys = version.manifest.sample_keys
    version.edit_manifest(sample_keys=(keys[1], keys[0], *keys[2:]))
    with pytest.raises(
        InvalidDatasetError, match=r"sample_key is not what the manifest says of samples \[0, 1\]"
    ):
        DatasetReader(version.root)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"blosc"', '"gzip"', "array video: codecs must be"),
        ('"order": [', '"order": [3, ', "array video: codecs must be"),
        ('"data_type": "int16"', '"data_type": "int32"', "array texture: data_type must be"),
        ('"fill_value": -1', '"fill_value": 0', "array texture: fill_value must be -1, and is 0"),
        ('"separator": "/"', '"separator": "."', "array video: chunk_key_encoding must be"),
        (
            '"viewpoint": {',
            '"view": {',
            "array viewpoint: there must be metadata, and there are none",
        ),
        ('"node_type": "group"', '"node_type": "array"', "zarr.json must be of a Zarr v3 group"),
    ],
)
def test_metadata_must_be_those_of_the_contract(clips, tmp_path, old, new, message):
    version = clips.copy(tmp_path / "v1")
    text = (version.root / "zarr.json").read_text()
    assert old in text
    version.rewrite("zarr.json", text.replace(old, new).encode())
    with pytest.raises(InvalidDatasetError, match=message):
        DatasetReader(version.root)


def test_metadata_must_say_the_order_of_bytes_of_a_number(clips, tmp_path):
    version = clips.copy(tmp_path / "v1")
    group = json.loads((version.root / "zarr.json").read_text())
    (order,) = [
        codec
        for codec in group["consolidated_metadata"]["metadata"]["texture"]["codecs"]
        if "bytes" in codec.values()
    ]
    del order["configuration"]["endian"]
    version.rewrite("zarr.json", json.dumps(group).encode())
    with pytest.raises(InvalidDatasetError, match="array texture: codecs must be"):
        DatasetReader(version.root)


def test_metadata_need_not_be_consolidated(clips, tmp_path):
    version = clips.copy(tmp_path / "v1")
    version.rewrite("zarr.json", b'{"zarr_format": 3, "node_type": "group", "attributes": {}}')
    assert np.array_equal(
        DatasetReader(version.root).read("video", [4]), version.arrays["video"][[4]]
    )


def test_a_manifest_cannot_lead_out_of_the_dataset(clips, tmp_path):
    version = clips.copy(tmp_path / "v1")
    entry = version.manifest.files[0].model_copy(update={"path": "video/../../secret"})
    version.edit_manifest(files=(*version.manifest.files, entry))
    Path(tmp_path, "secret").write_bytes(b"")
    with pytest.raises(InvalidDatasetError, match="which is not inside the dataset"):
        DatasetReader(version.root, verify=True)
