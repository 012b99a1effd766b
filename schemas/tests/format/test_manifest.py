"""Manifests: sections, what they list, and the three files that vouch for each other."""

from collections.abc import Callable
from typing import Any

import pytest
from pydantic import ValidationError
from stickslip_schemas.base import Reason, sha256
from stickslip_schemas.format import manifest as module
from stickslip_schemas.format.manifest import (
    MANIFEST_ATTRIBUTE,
    BrokenSealError,
    BrokenSectionError,
    Contents,
    FileEntry,
    Manifest,
    ManifestSection,
    Rejection,
    check_seal,
    has_sections,
    seal_text,
    section_path,
    section_samples,
    with_manifest_digest,
)
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.points import KeyedPoint, keyed_points
from stickslip_schemas.spec.jobs import JobSpec

BUILDS = Builds(sim_core="a" * 64, simulate="a" * 64, render="b" * 64, pack="c" * 64)
REJECTED = (1, 4)


def _spec(count: int = 5, per_shard: int = 2) -> JobSpec:
    axis = {"type": "linspace", "start": 1, "stop": 9, "num": count} if count > 1 else 1
    return job_spec_adapter.validate_python(
        {
            "kind": "rod_hang",
            "axes": {"gamma": axis, "phi0": 1, "phi1": 6},
            "samples_per_shard": per_shard,
        }
    )


def _entry(path: str, data: bytes) -> FileEntry:
    return FileEntry(path=path, sha256=sha256(data), size=len(data))


def _rejection(point: KeyedPoint) -> Rejection:
    return Rejection(
        slot=point.slot,
        sample_key=point.key,
        reason=Reason.out_of_frame,
        message="left",
        labels=point.labels,
    )


class Version:
    """A version of five samples in three shards, with sections of two samples or without any."""

    def __init__(self, *, sections: bool) -> None:
        self.spec = _spec()
        self.points = tuple(keyed_points(self.spec, BUILDS))
        self.rejections = tuple(_rejection(self.points[slot]) for slot in REJECTED)
        self.shards = [_entry(f"views/c/{shard}/0/0/0/0", b"%d" % shard) for shard in range(3)]
        self.stored: dict[str, bytes] = {}
        self.reads: list[str] = []
        listed = []
        for number, first in enumerate(range(0, 5, 2) if sections else ()):
            members = self.points[first : first + 2]
            section = ManifestSection(
                first=first,
                sample_keys=tuple(point.key for point in members),
                rejections=tuple(
                    item for item in self.rejections if first <= item.slot < first + 2
                ),
                files=(self.shards[number],),
            )
            path = section_path(number)
            self.stored[path] = section.model_dump_json().encode()
            listed.append(_entry(path, self.stored[path]))
        self.document: dict[str, Any] = {
            "dataset": self.spec.dataset_id,
            "version": 1,
            "spec": self.spec,
            "spec_digest": self.spec.content_digest,
            "builds": BUILDS,
            "cameras": (),
            "sample_count": 5,
            "valid_count": 3,
            "split_counts": {"train": 3},
            "rejection_counts": {Reason.out_of_frame: 2},
            "sections": tuple(listed),
            "rejections": () if sections else self.rejections,
            "sample_keys": () if sections else tuple(point.key for point in self.points),
            "files": (_entry("zarr.txt", b"root"), *(() if sections else self.shards)),
        }

    def contents(self, **changes: Any) -> Contents:
        return Contents(Manifest(**(self.document | changes)), self.read)

    def read(self, entry: FileEntry) -> bytes:
        self.reads.append(entry.path)
        return self.stored[entry.path]


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Version]:
    monkeypatch.setattr(module, "SECTION_SAMPLES", 3)  # one whole shard fits
    return Version


def test_a_section_is_whole_shards() -> None:
    assert section_samples(_spec(1, 64)) == 9984
    assert section_samples(_spec(1, 4096)) == 8192
    assert section_samples(_spec(1, 1)) == 10_000
    assert not has_sections(_spec(10_000))
    assert has_sections(_spec(10_001))


@pytest.mark.parametrize("sections", [True, False])
def test_contents_are_the_same_with_and_without_sections(
    make: Callable[..., Version], sections: bool
) -> None:
    version = make(sections=sections)
    contents = version.contents()
    assert tuple(contents.sample_keys()) == tuple(point.key for point in version.points)
    assert tuple(contents.rejections()) == version.rejections
    assert [item.labels for item in contents.rejections()] == [
        version.points[slot].labels for slot in REJECTED
    ]
    for shard in version.shards:
        assert contents.file(shard.path) == shard
    assert contents.file("zarr.txt") == _entry("zarr.txt", b"root")
    assert contents.file("views/c/3/0/0/0/0") is None
    assert contents.file("other/c/0") is None
    assert {entry.path for entry in contents.files()} == {
        "zarr.txt",
        *(shard.path for shard in version.shards),
        *version.stored,
    }


def test_a_file_is_found_in_the_one_section_that_lists_it(make: Callable[..., Version]) -> None:
    version = make(sections=True)
    contents = version.contents()
    assert contents.file(version.shards[2].path) == version.shards[2]
    assert version.reads == ["manifest/2.json"]


def test_a_manifest_names_all_its_sections_and_repeats_nothing(
    make: Callable[..., Version],
) -> None:
    version = make(sections=True)
    listed = version.document["sections"]
    for wrong in (listed[:2], listed[::-1], (*listed, listed[0])):
        with pytest.raises(ValidationError, match="sections must be 3"):
            version.contents(sections=wrong)
    with pytest.raises(ValidationError, match="must be empty"):
        version.contents(sample_keys=tuple(point.key for point in version.points))
    with pytest.raises(ValidationError, match="must be empty"):
        version.contents(rejections=version.rejections)


def test_a_section_is_the_one_that_the_manifest_lists(make: Callable[..., Version]) -> None:
    version = make(sections=True)
    version.stored["manifest/1.json"] += b" "
    with pytest.raises(BrokenSectionError, match=r"manifest/1\.json has SHA-256"):
        list(version.contents().sample_keys())
    swapped = make(sections=True)
    first, second, third = swapped.document["sections"]
    swapped.stored["manifest/0.json"] = swapped.stored["manifest/1.json"]
    listed = (first.model_copy(update={"sha256": second.sha256}), second, third)
    with pytest.raises(BrokenSectionError, match="must list the samples 0 to 1, and lists 2 to 3"):
        swapped.contents(sections=listed).section(0)


def test_a_manifest_has_this_format_only(make: Callable[..., Version]) -> None:
    document = make(sections=False).contents().manifest.model_dump(mode="json")
    assert document["format"] == "stickslip-dataset/3"
    for other in ("stickslip-dataset/1", "stickslip-dataset/2"):
        with pytest.raises(ValidationError, match="stickslip-dataset/3"):
            Manifest.model_validate(document | {"format": other})


def test_each_of_the_three_files_vouches_for_the_others() -> None:
    manifest = b'{"dataset": "ds"}'
    group = with_manifest_digest(b'{"attributes": {"format": "f"}}', sha256(manifest))
    seal = seal_text(sha256(manifest), sha256(group))
    assert check_seal(manifest, group, seal) == sha256(manifest)
    assert seal.decode().split() == [sha256(manifest), "manifest.json", sha256(group), "zarr.json"]
    with pytest.raises(BrokenSealError, match=r"^manifest\.json has SHA-256"):
        check_seal(manifest + b" ", group, seal)
    with pytest.raises(BrokenSealError, match=r"^zarr\.json has SHA-256"):
        check_seal(manifest, group + b" ", seal)
    with pytest.raises(BrokenSealError, match="one line each"):
        check_seal(manifest, group, seal + b"0  other\n")
    with pytest.raises(BrokenSealError, match="a digest and a name"):
        check_seal(manifest, group, b"\xff")
    other = with_manifest_digest(group, sha256(b"another"))
    with pytest.raises(BrokenSealError, match=f"{MANIFEST_ATTRIBUTE} must be that of"):
        check_seal(manifest, other, seal_text(sha256(manifest), sha256(other)))
    bare = b'{"attributes": {}}'
    with pytest.raises(BrokenSealError, match="must have the attribute"):
        check_seal(manifest, bare, seal_text(sha256(manifest), sha256(bare)))
