"""What every store promises, wherever it keeps its bytes."""

import itertools
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import zarr
import zarr.storage
from stickslip_schemas.base import sha256
from stickslip_schemas.store import (
    CorruptArtifactError,
    DirectoryStore,
    Store,
    artifact_name,
    open_store,
    store_place,
)
from zarr.abc.store import Store as ZarrStore

if TYPE_CHECKING:
    from stickslip_testing.s3 import Proxy

NOWHERE = sha256(b"nobody has published this")
LARGE = np.random.default_rng(1).bytes(5_000_000)
"""More than a block of a stream."""


@dataclass(frozen=True)
class Place:
    """Somewhere a store can be."""

    url: str
    store: Store
    damage: Callable[[str, bytes], None]
    """Give an artifact other bytes, behind the store's back."""
    zarr: Callable[[str], ZarrStore]
    """Return the store that a Zarr reader has for a path below the root."""


def directory(root: Path) -> Place:
    store = DirectoryStore(root)

    def damage(digest: str, data: bytes) -> None:
        store.path(digest).write_bytes(data)

    return Place(
        root.as_uri(),
        store,
        damage,
        lambda path: zarr.storage.LocalStore(root / path, read_only=True),
    )


@pytest.fixture(scope="module")
def server() -> Iterator["Proxy"]:
    """A real S3 server behind a proxy."""
    pytest.importorskip("obstore", reason="obstore is not installed: make setup-dev")
    pytest.importorskip("moto", reason="moto is not installed: make setup-dev")
    from stickslip_testing.s3 import s3_proxy

    with s3_proxy() as proxy:
        yield proxy


def bucket(proxy: "Proxy", name: str, monkeypatch: pytest.MonkeyPatch) -> Place:
    import obstore
    import obstore.store
    import stickslip_schemas.store.bucket
    from stickslip_schemas.store.bucket import BucketStore
    from stickslip_testing.s3 import make_bucket, no_fault, variables

    proxy.fault = no_fault
    monkeypatch.setattr(stickslip_schemas.store.bucket, "RETRY_SECONDS", 5.0)
    make_bucket(proxy, name)
    for variable, value in variables(proxy).items():
        monkeypatch.setenv(variable, value)
    root = obstore.store.S3Store(name, prefix="a lab/store")

    def damage(digest: str, data: bytes) -> None:
        obstore.put(root, artifact_name(digest), data, use_multipart=False)

    return Place(
        f"s3://{name}/a%20lab/store",
        BucketStore(name, "a lab/store"),
        damage,
        lambda path: zarr.storage.ObjectStore(
            obstore.store.S3Store(name, prefix=f"a lab/store/{path}"), read_only=True
        ),
    )


_numbers = itertools.count()


@pytest.fixture(params=["directory", pytest.param("bucket", marks=pytest.mark.real)])
def place(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    """An empty store of each sort."""
    if request.param == "directory":
        return directory(tmp_path / "the store")
    return bucket(request.getfixturevalue("server"), f"bucket-{next(_numbers)}", monkeypatch)


@pytest.fixture
def store(place: Place) -> Store:
    return place.store


@pytest.mark.parametrize("data", [b"", b"0123456789", LARGE])
def test_what_is_published_is_read(place: Place, data: bytes) -> None:
    digest = place.store.publish(data)
    assert digest == sha256(data)
    other = open_store(place.url)
    assert other.read(digest) == data
    assert other.size(digest) == len(data)
    assert other.holds(digest)
    assert other.holds(digest, size=len(data))
    assert not other.holds(digest, size=len(data) + 1)
    assert other.exists(digest, size=len(data))
    assert not other.exists(digest, size=len(data) + 1)


def test_parts_are_read(store: Store) -> None:
    digest = store.publish(b"0123456789")
    assert store.read(digest, offset=2, length=3) == b"234"
    assert store.read(digest, offset=7) == b"789"
    assert store.read(digest, length=2) == b"01"
    assert store.read(digest, offset=4, length=0) == b""
    assert store.read(digest, offset=0, length=10) == b"0123456789"


@pytest.mark.parametrize(("start", "stop"), [(0, len(LARGE)), (100_000, 4_999_999), (5, 5)])
def test_a_stream_has_the_bytes_between_its_ends(store: Store, start: int, stop: int) -> None:
    digest = store.publish(LARGE)
    blocks = list(store.stream(digest, start, stop))
    assert b"".join(blocks) == LARGE[start:stop]
    assert all(0 < len(block) <= 1 << 22 for block in blocks)


@pytest.mark.parametrize(("offset", "length"), [(1, 10), (10, 1), (1000, 1)])
def test_what_lies_behind_the_end_is_an_error(store: Store, offset: int, length: int) -> None:
    digest = store.publish(b"0123456789")
    with pytest.raises(CorruptArtifactError, match="ends before"):
        store.read(digest, offset=offset, length=length)
    with pytest.raises(CorruptArtifactError, match="ends before"):
        list(store.stream(digest, offset, offset + length))


def test_what_is_not_there_is_said_so(store: Store) -> None:
    assert not store.exists(NOWHERE)
    assert not store.holds(NOWHERE)
    for ask in (
        store.read,
        store.size,
        lambda digest: store.read(digest, offset=1, length=1),
        lambda digest: list(store.stream(digest, 0, 1)),
        lambda digest: store.show(digest, "ds-1", 1, "views/c/0"),
    ):
        with pytest.raises(FileNotFoundError):
            ask(NOWHERE)
    with pytest.raises(FileNotFoundError):
        store.read_shown("ds-1", 1, "views/c/0")
    assert not store.shows(NOWHERE, "ds-1", 1, "views/c/0")
    assert not store.is_shown("ds-1", 1)


@pytest.mark.parametrize(
    "name", ["", "../../etc/passwd", "A" * 64, "f" * 63, f".{'f' * 64}./x.tmp", f".{'f' * 64}.tm"]
)
def test_only_a_digest_names_an_artifact(store: Store, name: str) -> None:
    for ask in (
        store.read,
        store.size,
        store.exists,
        store.holds,
        store.delete,
        lambda digest: store.show(digest, "ds-1", 1, "file"),
    ):
        with pytest.raises(ValueError, match=r"digest|name"):
            ask(name)


@pytest.mark.parametrize("wrong", [b"datb", b"dat", b"data and more", b""])
def test_a_damaged_artifact_is_noticed_and_written_anew(place: Place, wrong: bytes) -> None:
    store = place.store
    digest = store.publish(b"data")
    place.damage(digest, wrong)
    with pytest.raises(CorruptArtifactError, match=digest):
        store.read(digest)
    assert not store.holds(digest)
    assert store.publish(b"data") == digest
    assert store.read(digest) == b"data"


def test_a_deleted_artifact_is_gone(store: Store) -> None:
    remaining, deleted = store.publish(b"kept"), store.publish(b"deleted")
    for _ in range(2):
        store.delete(deleted)
        assert not store.exists(deleted)
    assert [file.name for file in store.stored()] == [remaining]
    assert store.read(remaining) == b"kept"


def test_all_artifacts_are_listed(store: Store) -> None:
    assert list(store.stored()) == []
    before = time.time()
    sizes = {store.publish(bytes([k]) * (k + 1)): k + 1 for k in range(40)}
    listed = list(store.stored())
    assert {file.name: file.bytes for file in listed} == sizes
    assert [file.name for file in listed] == sorted(sizes)
    assert all(before - 2 <= file.modified_at <= time.time() + 2 for file in listed)
    assert not any(file.is_shown for file in listed)


def test_a_version_shows_artifacts_until_it_is_hidden(store: Store) -> None:
    shard, other = store.publish(b"shard"), store.publish(b"other")
    for _ in range(2):
        store.show(shard, "ds-1", 1, "views/c/0")
    store.show(shard, "ds-1", 12, "views/c/0")
    store.show(other, "ds-2", 1, "manifest.json")
    assert store.read_shown("ds-1", 1, "views/c/0") == b"shard"
    assert store.shows(shard, "ds-1", 1, "views/c/0")
    assert not store.shows(other, "ds-1", 1, "views/c/0")
    assert not store.shows(shard, "ds-1", 1, "views/c/1")
    assert [(version.dataset, version.version) for version in store.versions("views/c/0")] == [
        ("ds-1", 1),
        ("ds-1", 12),
    ]
    assert [(version.dataset, version.version) for version in store.versions("manifest.json")] == [
        ("ds-2", 1)
    ]
    assert sorted(file.name for file in store.stored()) == sorted([shard, other])
    for _ in range(2):
        store.hide("ds-1", 1)
        assert not store.is_shown("ds-1", 1)
    assert store.is_shown("ds-1", 12)
    assert store.read(shard) == b"shard"


def test_a_version_can_show_another_artifact_in_its_place(store: Store) -> None:
    first, second = store.publish(b"first"), store.publish(b"second")
    store.show(first, "ds-1", 1, "file")
    store.show(second, "ds-1", 1, "file")
    assert store.read_shown("ds-1", 1, "file") == b"second"
    assert store.read(first) == b"first"


def test_a_version_keeps_what_it_shows(store: Store) -> None:
    """`stickslip reindex` puts artifacts back that somebody has deleted."""
    digest = store.publish(b"shard")
    store.show(digest, "ds-1", 1, "file")
    store.delete(digest)
    assert store.read_shown("ds-1", 1, "file") == b"shard"
    assert store.shows(digest, "ds-1", 1, "file")


@pytest.mark.parametrize(
    "path", ["", "/etc/passwd", "../v2/file", "views/../../x", "views//c", "./file"]
)
def test_a_version_shows_nothing_outside_itself(store: Store, path: str) -> None:
    digest = store.publish(b"shard")
    for ask in (store.show, store.shows):
        with pytest.raises(ValueError, match="path must be relative"):
            ask(digest, "ds-1", 1, path)
    with pytest.raises(ValueError, match="path must be relative"):
        store.read_shown("ds-1", 1, path)


def test_one_of_many_writers_wins_and_no_reader_sees_a_part(place: Place) -> None:
    digest, wrong, stop = sha256(LARGE), [], threading.Event()

    def watch() -> None:
        reader = open_store(place.url)
        while not stop.is_set():
            try:
                size = reader.size(digest)
            except FileNotFoundError:
                continue
            wrong.extend([size] if size != len(LARGE) else [])

    watcher = threading.Thread(target=watch)
    watcher.start()
    with ThreadPoolExecutor(8) as writers:
        digests = list(writers.map(lambda _: open_store(place.url).publish(LARGE), range(16)))
    stop.set()
    watcher.join()
    assert wrong == []
    assert set(digests) == {digest}
    assert [file.name for file in place.store.stored()] == [digest]
    assert place.store.read(digest) == LARGE


def test_a_probe_leaves_nothing(store: Store) -> None:
    store.probe()
    assert list(store.stored()) == []
    room = store.disk_usage()
    assert room is None or 0 < room.free <= room.total


def test_a_plain_zarr_reader_opens_a_version(place: Place) -> None:
    values = np.arange(24, dtype="<f4").reshape(4, 6)
    memory = zarr.storage.MemoryStore()
    group = zarr.create_group(memory)
    group.create_array("views", data=values, chunks=(1, 6), shards=(2, 6))
    for path, data in memory._store_dict.items():
        place.store.show(place.store.publish(data.to_bytes()), "ds-1", 1, path)
    views = zarr.open_group(place.zarr("datasets/ds-1/v1"), mode="r")["views"]
    assert isinstance(views, zarr.Array)
    assert np.array_equal(views[:], values)


def test_stores_are_opened_by_path_and_by_url(tmp_path: Path) -> None:
    root = tmp_path / "a store"
    digest = open_store(root).publish(b"data")
    for place in (
        str(root),
        root.as_uri(),
        f"file://localhost{root.as_uri().removeprefix('file://')}",
    ):
        assert open_store(place).read(digest) == b"data"


@pytest.mark.parametrize(
    "url",
    [
        "ftp://host/store",
        "file://host/store",
        "http://host/store",
        "",
        "s3:",
        "s3:/bucket",
        "s3:///store",
        "S3://bucket",
        "s3://user@bucket",
        "s3://bucket?region=x",
        "s3://[",
        "file:store",
        "name:of a directory",
    ],
)
def test_other_urls_are_refused(url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        ValueError, match=r"store must be a directory, .*; got '.*'\. Write \./NAME"
    ):
        open_store(url)
    assert list(tmp_path.iterdir()) == []


def test_a_place_is_the_same_for_every_process_of_a_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    here = str(tmp_path / "a store")
    for place in ("a store", Path("a store"), here, Path(here).as_uri()):
        assert store_place(place) == here
    for place in ("s3://lab/a b", "s3://lab/a%20b/", "s3://lab//a b"):
        assert store_place(place) == "s3://lab/a%20b"
    assert store_place("s3://lab") == store_place("s3://lab/") == "s3://lab"
    assert store_place("./name:of a directory") == str(tmp_path / "name:of a directory")


def test_a_bucket_without_obstore_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("store.bucket", "transport.objects"):
        monkeypatch.delitem(sys.modules, f"stickslip_schemas.{name}", raising=False)
    monkeypatch.setitem(sys.modules, "obstore", None)
    with pytest.raises(
        ValueError,
        match=r"needs obstore, which is not installed: run `pip install './schemas\[s3\]'`",
    ):
        open_store("s3://bucket/store")
