"""The store: artifacts whole or not at all, and never with other bytes than their name says."""

import os
from pathlib import Path

import pytest
from stickslip_schemas.base import sha256
from stickslip_schemas.store import CorruptArtifactError, DirectoryStore, sync, write_durably


def test_publish_and_read(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path)
    digest = store.publish(b"0123456789")
    assert digest == sha256(b"0123456789")
    assert store.read(digest) == b"0123456789"
    assert store.read(digest, offset=2, length=3) == b"234"


def test_publishing_twice_keeps_the_first_file(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path)
    digest = store.publish(b"data")
    before = store.path(digest).stat().st_ino
    assert store.publish(b"data") == digest
    assert store.path(digest).stat().st_ino == before


def test_changed_bytes_are_found(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path)
    digest = store.publish(b"data")
    store.path(digest).write_bytes(b"dato")
    with pytest.raises(CorruptArtifactError, match=digest):
        store.read(digest)
    with pytest.raises(CorruptArtifactError, match="ends before"):
        store.read(digest, offset=1, length=9)


@pytest.mark.parametrize("name", ["../../etc/passwd", "", "A" * 64, "0" * 63, "0" * 64 + "\n"])
def test_a_path_is_a_digest_and_nothing_else(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="64 lower-case hexadecimal"):
        DirectoryStore(tmp_path).path(name)


def test_a_failed_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_space(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(OSError, match="No space"):
        write_durably(tmp_path / "a" / "file", b"data")
    assert list((tmp_path / "a").iterdir()) == []


def test_link_is_the_same_file_and_can_be_repeated(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path)
    digest = store.publish(b"shard")
    target = store.dataset_path("ds-1", 1) / "views" / "c" / "0"
    for _ in range(2):
        store.show(digest, "ds-1", 1, "views/c/0")
        assert target.read_bytes() == b"shard"
        assert target.stat().st_ino == store.path(digest).stat().st_ino
        assert [path.name for path in target.parent.iterdir()] == ["0"]


@pytest.mark.parametrize("wrong", [b"shart", b"sha", b""])
def test_a_damaged_artifact_is_mended_in_all_versions(tmp_path: Path, wrong: bytes) -> None:
    store = DirectoryStore(tmp_path)
    digest, other = store.publish(b"shard"), store.publish(b"other")
    for version in (1, 2):
        store.show(digest, "ds-1", version, "views/c/0")
        store.show(other, "ds-1", version, "views/c/1")
    store.path(digest).write_bytes(wrong)
    assert store.read_shown("ds-1", 2, "views/c/0") == wrong
    store.publish(b"shard")
    assert [store.read_shown("ds-1", version, "views/c/0") for version in (1, 2)] == [
        b"shard",
        b"shard",
    ]
    assert [store.read_shown("ds-1", version, "views/c/1") for version in (1, 2)] == [
        b"other",
        b"other",
    ]
    assert store.path(digest).stat().st_nlink == 3


def test_link_copies_where_it_cannot_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(source: Path, target: Path) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", no_links)
    store = DirectoryStore(tmp_path)
    store.show(store.publish(b"shard"), "ds-1", 1, "file")
    assert (store.dataset_path("ds-1", 1) / "file").read_bytes() == b"shard"


def test_a_file_and_its_name_are_synced_before_a_write_returns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[Path] = []
    monkeypatch.setattr(
        os,
        "fsync",
        lambda descriptor: synced.append(Path(f"/proc/self/fd/{descriptor}").readlink()),
    )
    write_durably(tmp_path / "file", b"data")
    assert synced[0].name.startswith(".file.")
    assert synced[1:] == [tmp_path]
    sync(tmp_path / "file")
    assert synced[2:] == [tmp_path / "file"]
