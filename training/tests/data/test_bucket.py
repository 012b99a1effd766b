"""Datasets in a bucket: the reader on a real S3 server."""

import os
import pickle

import numpy as np
import pytest
from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.samples import Samples
from stickslip_training.data.sources import (
    BucketSource,
    CorruptDataError,
    MissingFileError,
    SourceError,
    open_source,
)

pytest.importorskip("obstore", reason="obstore is not installed: make setup-dev")
pytest.importorskip("moto", reason="moto is not installed: make setup-dev")

import obstore.store
from stickslip_testing.s3 import make_bucket, s3_proxy, variables

pytestmark = pytest.mark.real


@pytest.fixture(scope="module")
def server():
    """A server, and the variables that lead to it."""
    with s3_proxy() as proxy:
        patch = pytest.MonkeyPatch()
        for name, value in variables(proxy).items():
            patch.setenv(name, value)
        make_bucket(proxy, "lab")
        yield proxy
        patch.undo()


def put(version, prefix: str) -> str:
    objects = obstore.store.S3Store("lab", prefix=prefix)
    for path in version.root.rglob("*"):
        if path.is_file():
            obstore.put(objects, path.relative_to(version.root).as_posix(), path.read_bytes())
    return f"s3://lab/{prefix}"


@pytest.fixture(scope="module")
def clips_url(server, clips):
    return put(clips, "one/datasets/ds-0123456789abcdef/v1")


def test_values_are_those_of_the_directory(clips_url, clips):
    with DatasetReader(clips_url) as reader, DatasetReader(clips.root) as local:
        slots = local.slots()
        assert np.array_equal(reader.slots(), slots)
        for name in local.arrays:
            assert np.array_equal(
                reader.read(name, slots), local.read(name, slots), equal_nan=name != "video"
            ), name


def test_a_sample_is_one_request(clips_url, server, monkeypatch):
    with DatasetReader(clips_url) as reader:
        slots = reader.slots()
        reader.read("video", slots)  # the indexes of the shards are read once
        asked = []
        inner = obstore.get_range
        monkeypatch.setattr(
            obstore, "get_range", lambda *a, **k: asked.append(a[1]) or inner(*a, **k)
        )
        reader.read("video", slots)
        assert len(asked) == len(slots)


@pytest.mark.real
def test_workers_that_are_spawned_read_it(clips_url, clips):
    dataset = Samples(clips_url, "train")
    loader = dataset.loader(2, num_workers=1, multiprocessing_context="spawn")
    read = {
        int(slot): video
        for batch in loader
        for slot, video in zip(batch["slot"], batch["video"], strict=True)
    }
    assert sorted(read) == dataset.slots.tolist()
    for slot, video in read.items():
        assert np.array_equal(video.numpy(), clips.arrays["video"][slot])


def test_a_fork_is_told_to_be_a_spawn(clips_url, monkeypatch):
    source = open_source(clips_url)
    source.read_manifest()
    monkeypatch.setattr(os, "getpid", lambda: -1)
    with pytest.raises(SourceError, match="multiprocessing_context"):
        source.read_manifest()
    assert pickle.loads(pickle.dumps(source)).read_manifest()


def test_what_is_not_there_is_told(server, clips, clips_url):
    with pytest.raises(MissingFileError, match="no committed dataset version"):
        DatasetReader("s3://lab/one/datasets/ds-0000000000000000/v1")
    with pytest.raises(MissingFileError, match="no committed dataset version"):
        DatasetReader("s3://another/v1")
    with pytest.raises(ValueError, match="s3://BUCKET"):
        BucketSource("s3:///v1")


def test_a_server_that_refuses_is_told(server, clips_url, monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setattr(BucketSource, "RETRY_SECONDS", 1.0)
    with pytest.raises(SourceError, match="cannot be read"):
        DatasetReader(clips_url)


def test_a_shard_that_is_too_short_is_told(server, clips, tmp_path):
    version = clips.copy(tmp_path / "short")
    path = version.root / "video/c/0/0/0/0/0"
    path.write_bytes(path.read_bytes()[:-100])
    with (
        DatasetReader(put(version, "short")) as reader,
        pytest.raises((CorruptDataError, SourceError)),
    ):
        reader.read("video", reader.slots()[:1])
